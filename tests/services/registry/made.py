"""Packed models to upload, and registries with a stub check."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch

from gsplat_core.deformation import new_field
from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from services.registry.bundle_file import pack
from services.registry.models import ModelRegistry
from services.registry.records import Recovery


def save_model(folder: Path, seed: int = 0, count: int = 5) -> Path:
    """Save a bundle of a few Gaussians in front of a small camera, different for each seed."""
    random = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=random)
    means = draw(count, 3)
    means[:, 2] += 20
    gaussians = Gaussians(means, draw(count, 4), draw(count, 3), draw(count), draw(count, 1, 3))
    field = new_field("basis", gaussians, (0.0, 1.0), bumps=6).detached_copy()
    save_bundle(Model(1, gaussians, field, Camera.from_focal(50.0, 16, 12), (0.0, 1.0)), folder)
    return folder


def packed_model(folder: Path, seed: int = 0) -> Path:
    """Return the path of a packed model, made on first use."""
    file = folder / f"model-{seed}.isplat"
    if not file.exists():
        pack(save_model(folder / f"model-{seed}", seed), file)
    return file


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def add_ready(registry: ModelRegistry, files: Path, seed: int = 0, name: str = "liver") -> int:
    """Upload a model and check it. Return the number of the version."""
    record = registry.upload(name, packed_model(files, seed), None, "surgeon")
    assert registry.check(name, record.version).state == "ready"
    return record.version


def assert_whole(registry: ModelRegistry, name: str = "liver") -> None:
    """Check that at most one version is active and current, that versions have their files, and nothing else exists."""
    (model,) = [each for each in registry.models() if each.name == name]
    versions = registry.versions(name)
    assert [each.version for each in versions if each.state == "active"] == [model.active] * (model.active is not None)
    assert model.last_version >= max(each.version for each in versions)
    for each in versions:
        folder = registry.folder_of(name, each.version)
        assert sorted(path.name for path in folder.iterdir()) == ["manifest.json", "model.safetensors"]
    every = [each for model in registry.models() for each in registry.versions(model.name)]
    unchecked = tuple((each.name, each.version) for each in every if each.state in ("uploaded", "validated"))
    assert registry.recover() == Recovery(unchecked=unchecked)
