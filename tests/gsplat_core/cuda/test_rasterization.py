"""`rasterization` of CUDA tensors: the whole image with its gradients against the reference in float64 and the CPU."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsplat_core import rasterization, reference


def run(function, scene, device="cuda", **options) -> tuple[list[Tensor], dict]:
    """Image, alpha and the gradients of a random weighting of both, on the CPU; and the call's meta."""
    leaves = [t.detach().to(device).requires_grad_() for t in scene.leaves()]
    image, alpha, meta = function(*leaves, scene.Ks.to(device), scene.width, scene.height, sh_degree=3, **options)
    g = torch.Generator().manual_seed(5)
    total = sum((t * torch.rand(t.shape, generator=g, dtype=torch.float64).to(t)).sum() for t in (image, alpha))
    gradients = torch.autograd.grad(total, leaves, allow_unused=True) if total.requires_grad else [None] * len(leaves)
    zeros = [torch.zeros_like(t) if v is None else v for t, v in zip(leaves, gradients, strict=True)]
    return [t.detach().cpu() for t in (image, alpha, *zeros)], meta


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize(
    ("count", "batch", "cameras", "options"),
    [
        (60, (), 1, {"packed": False, "render_mode": "RGB+ED"}),
        (60, (), 1, {"packed": True, "render_mode": "RGB+D", "rasterize_mode": "antialiased"}),
        (25, (2,), 2, {"packed": True, "tile_size": 8}),
        (25, (2, 1), 2, {"packed": False, "eps2d": 0.1}),
        (1, (), 1, {}),
        (0, (), 2, {"render_mode": "RGB+ED"}),
    ],
)
def test_cuda_rasterization_matches_reference_and_cpu(make_scene, assert_near, model, count, batch, cameras, options):
    scene = make_scene(count, batch, cameras, model)
    ours, meta = run(rasterization, scene.to(torch.float32), **options)
    assert meta["means2d"].is_cuda
    exact, _ = run(reference.rasterization, scene.to(torch.float64), "cpu", **options)
    on_cpu, _ = run(rasterization, scene.to(torch.float32), "cpu", **options)
    if count > 1:
        assert exact[1].max() > 0.5
    for wanted in (exact, on_cpu):
        for i, (a, w) in enumerate(zip(ours, wanted, strict=True)):
            assert_near(
                a, w, **({"relative": 1e-3, "of_largest": 1e-4} if i < 2 else {"relative": 1e-2, "of_largest": 1e-3})
            )


def test_cuda_rasterization_non_finite_gaussians_do_not_affect_others(make_scene):
    scene = make_scene(50).to(torch.float32)
    for row, tensor in enumerate(
        (scene.means, scene.quats, scene.scales, scene.opacities[:, None], scene.sh.flatten(1))
    ):
        tensor[1 + row, 0] = math.nan
    (image, alpha, *gradients), _ = run(rasterization, scene, packed=False)
    assert image.isfinite().all()
    assert alpha.max() > 0.5
    for gradient in gradients[:5]:
        assert gradient.isfinite().all()
        assert not gradient[1:6].any()


def test_cuda_rasterization_is_deterministic(make_scene):
    scene = make_scene(2000, cameras=2, width=200, height=150).to(torch.float32)
    first, second = (run(rasterization, scene, packed=False, render_mode="RGB+ED")[0] for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


def test_cuda_rasterization_packed_equals_dense_image(make_scene):
    scene = make_scene(300, cameras=2).to(torch.float32)
    dense, packed = (run(rasterization, scene, packed=p)[0] for p in (False, True))
    assert torch.equal(dense[0], packed[0])
