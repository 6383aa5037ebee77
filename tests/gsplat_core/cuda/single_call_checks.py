"""Scenes as CUDA leaves, one run of a `rasterization` with its gradients, and how close two of them must be."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.rendering import pipeline

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def inputs(scene, **changes) -> dict[str, Tensor]:
    """The scene's tensors as leaves in float32 on the GPU."""
    names = {"colors": "sh"}
    tensors = {name: getattr(scene, names.get(name, name)) for name in NAMES} | changes
    return {name: t.detach().float().cuda().requires_grad_() for name, t in tensors.items()}


def run(function, scene, leaves: dict[str, Tensor], **options):
    """Image, alphas and the gradients of a random weighting of both, by name; and the meta."""
    leaves = {name: t.detach().clone().requires_grad_(t.requires_grad) for name, t in leaves.items()}
    arguments = {"sh_degree": 3, "Ks": scene.Ks.float().cuda(), "width": scene.width, "height": scene.height} | options
    image, alphas, meta = function(**leaves, **arguments)
    random = torch.Generator().manual_seed(3)
    weights = [torch.rand(t.shape, generator=random).cuda() for t in (image, alphas)]
    wanted = [t for t in leaves.values() if t.requires_grad]
    found = torch.autograd.grad((image * weights[0]).sum() + (alphas * weights[1]).sum(), wanted, allow_unused=True)
    gradients = iter(found)
    result = {"image": image.detach(), "alphas": alphas.detach()}
    for name, t in leaves.items():
        if t.requires_grad:
            gradient = next(gradients)
            result[name] = torch.zeros_like(t) if gradient is None else gradient
    return result, meta


def assert_same(seen: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Pictures within 2e-4 but for single pixels at a cut-off, gradients within 2e-3 of their norm."""
    for name, w in wanted.items():
        s = seen[name]
        assert s.shape == w.shape and s.isfinite().all(), name
        error = (s - w).abs()
        if name in ("image", "alphas"):
            scale = max(1.0, float(w.abs().max())) if w.numel() else 1.0
            assert (error > 2e-4 * scale).double().mean() < 2e-3, name
            assert error.square().mean() <= 1e-6 * scale**2, name
        else:
            assert error.norm() <= 2e-3 * w.norm() + 1e-6, (name, float(error.norm()), float(w.norm()))


def check_lists(meta: dict) -> None:
    """The lists are sorted, complete, and say of themselves what gsplat's would."""
    length = len(meta["flatten_ids"])
    assert length == len(meta["isect_ids"]) == int(meta["tiles_per_gauss"].sum())
    tiles = meta["tile_width"] * meta["tile_height"]
    keys = pipeline.isect_ids_of(meta["flatten_ids"], meta["isect_offsets"], meta["depths"], tiles)
    assert torch.equal(meta["isect_ids"], keys)
    assert torch.equal(keys, keys.sort().values)
    counts = torch.bincount(meta["flatten_ids"], minlength=meta["depths"].numel())
    assert torch.equal(counts.int(), meta["tiles_per_gauss"].flatten())
