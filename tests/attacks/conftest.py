"""Bundles of a small model that tests tamper with."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from gsplat_core.deformation import new_field
from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians


class TamperedBundle:
    """Bundle of five Gaussians with methods that change it and recompute its digests, as an attacker can."""

    def __init__(self, folder: Path, kind: str = "basis", **architecture: Any) -> None:
        self.folder = folder
        self.manifest, self.tensors = folder / "manifest.json", folder / "model.safetensors"
        random = torch.Generator().manual_seed(0)
        draw = lambda *shape: torch.randn(*shape, generator=random)
        gaussians = Gaussians(draw(5, 3), draw(5, 4), draw(5, 3), draw(5), draw(5, 1, 3))
        field = new_field(kind, gaussians, (0.0, 1.0), **architecture).detached_copy()
        save_bundle(Model(1, gaussians, field, Camera.from_focal(50.0, 8, 8), (0.0, 1.0)), folder)

    def values(self) -> dict[str, Any]:
        """Return the manifest's content."""
        return json.loads(self.manifest.read_text())

    def edit(self, change: Callable[[dict[str, Any]], object]) -> None:
        """Change the manifest's values in place."""
        values = self.values()
        change(values)
        self.manifest.write_text(json.dumps(values))

    def set(self, path: str, value: object) -> None:
        """Replace one value of the manifest: `set("camera.width_px", 3)`."""

        def change(values: dict[str, Any]) -> None:
            *objects, name = path.split(".")
            for each in objects:
                values = values[each]
            values[name] = value

        self.edit(change)

    def replace_tensors(self, payload: bytes) -> None:
        """Replace the tensor file, with a matching digest."""
        self.tensors.write_bytes(payload)
        tensors = {"bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
        self.edit(lambda manifest: manifest.update(tensors=tensors))

    def header_and_data(self) -> tuple[bytes, bytes]:
        """Return the tensor file's header and data."""
        payload = self.tensors.read_bytes()
        (size,) = struct.unpack("<Q", payload[:8])
        return payload[8 : 8 + size], payload[8 + size :]

    def replace_header(self, header: bytes) -> None:
        """Write the same tensor data under another header."""
        self.replace_tensors(struct.pack("<Q", len(header)) + header + self.header_and_data()[1])


@pytest.fixture
def bundle(tmp_path: Path) -> TamperedBundle:
    """A bundle with a basis field of six bumps."""
    return TamperedBundle(tmp_path / "bundle", bumps=6)


@pytest.fixture
def hexplane_bundle(tmp_path: Path) -> TamperedBundle:
    """A bundle with a small HexPlane field."""
    return TamperedBundle(tmp_path / "bundle", "hexplane", channels=2, resolution=(3, 3, 3, 3), width=4, depth=1)
