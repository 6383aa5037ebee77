"""Static random models for measurements of the service, with API calls to upload, activate and roll back."""

from __future__ import annotations

import base64
import hashlib
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from service_server import Server

from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from services.registry.bundle_file import pack

NAME = "swapped"


def packed_model(seed: int, gaussians: int, width_px: int, height_px: int) -> bytes:
    """Write a random scene in front of the camera as one file; the seed selects the scene."""
    random = torch.Generator().manual_seed(seed)
    spread = lambda *shape: torch.rand(*shape, generator=random)
    scene = Gaussians(
        (spread(gaussians, 3) - 0.5) * torch.tensor([80.0, 64.0, 20.0]) + torch.tensor([0.0, 0.0, 60.0]),
        torch.nn.functional.normalize(spread(gaussians, 4), dim=1),
        spread(gaussians, 3) - 0.5,
        spread(gaussians) * 2,
        spread(gaussians, 1, 3) * 2 - 1,
    )
    camera = Camera.from_focal(0.8 * width_px, width_px, height_px)
    with tempfile.TemporaryDirectory() as folder:
        save_bundle(Model(1, scene, None, camera, (0.0, 1.0)), Path(folder) / "model")
        pack(Path(folder) / "model", Path(folder) / "model.isplat")
        return (Path(folder) / "model.isplat").read_bytes()


def upload(server: Server, content: bytes, within_s: float = 120.0) -> int:
    """Upload a version, wait for its check, and return its number."""
    digest = base64.b64encode(hashlib.sha256(content).digest()).decode()
    headers = {"Content-Type": "application/octet-stream", "Content-Digest": f"sha-256=:{digest}:"}
    version = server.ask(f"/v1/models/{NAME}/versions", "PUT", content, headers)["version"]
    until_s = time.monotonic() + within_s
    while (found := server.ask(f"/v1/models/{NAME}/versions/{version}"))["state"] != "ready":
        if found["state"] == "rejected" or time.monotonic() > until_s:
            raise RuntimeError(f"the model is {found}")
        time.sleep(0.1)
    return version


def activate(server: Server, version: int, current: int | None) -> None:
    """Activate a version in place of another one."""
    server.ask(f"/v1/models/{NAME}/activate", "POST", {"version": version, "expected_current": current})


def roll_back(server: Server) -> int:
    """Roll back, and return the active version's number."""
    return server.ask(f"/v1/models/{NAME}/rollback", "POST")["version"]


def registered(server: Server) -> dict[str, Any]:
    """Return the registry's active version, and each version's digest and size."""
    versions = server.ask(f"/v1/models/{NAME}/versions")
    active = next(model["active"] for model in server.ask("/v1/models") if model["name"] == NAME)
    return {
        "active": active,
        "versions": sorted((each["version"], each["digest"], each["size_bytes"]) for each in versions),
    }
