"""`Rasterizer`: the pictures and gradients of `rasterization` with the same options."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import Camera, Gaussians, InvalidInput, Rasterizer, rasterization


def gaussians(seed=0):
    g = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=g)
    return Gaussians(
        means=normal(30, 3) + torch.tensor([0, 0, 6.0]), quats=normal(30, 4), log_scales=normal(30, 3) * 0.3 - 1.5,
        logit_opacities=normal(30), sh=normal(30, 9, 3) * 0.3,
    )  # fmt: skip


CAMERA = Camera.from_focal(40.0, 40, 30)


@pytest.mark.parametrize(
    "options",
    [
        {}, {"render_mode": "RGB+ED"}, {"render_mode": "D", "tile_size": 8}, {"packed": True, "radius_clip": 2.0},
        {"rasterize_mode": "antialiased", "eps2d": 0.1}, {"constants": "1.5.3", "near_plane": 5.0, "far_plane": 7.0},
    ],
)  # fmt: skip
def test_rasterizer_equals_rasterization(options):
    scene = gaussians().requires_grad_()
    viewmat, K = CAMERA.matrices("cpu", torch.float32)
    behind = torch.tensor([0.2, 0.4, 0.6])
    wanted, alphas, _ = rasterization(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, viewmat[None], K[None], 40, 30, sh_degree=2,
        **({"packed": False, "backgrounds": None if options.get("render_mode") == "D" else behind[None]} | options),
    )  # fmt: skip
    picture = Rasterizer(background=behind, **options)(scene, CAMERA)
    assert torch.equal(picture.colors, wanted[0]) and torch.equal(picture.alphas, alphas[0])
    leaves = list(scene.left_tensors)
    ours = torch.autograd.grad(picture.colors.sum(), leaves, allow_unused=True, materialize_grads=True)
    theirs = torch.autograd.grad(wanted.sum(), leaves, allow_unused=True, materialize_grads=True)
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_rasterizer_accepts_changing_gaussians_and_cameras():
    rasterizer = Rasterizer()
    first = rasterizer(gaussians(), CAMERA).colors
    assert rasterizer(gaussians(1), Camera.from_focal(30.0, 20, 16)).colors.shape == (16, 20, 3)
    assert torch.equal(rasterizer(gaussians(), CAMERA).colors, first)
    assert rasterizer.capacity is None


def test_rasterizer_rejects_invalid_options_at_construction():
    for options, message in [
        ({"tile_size": 0}, "tile_size must be from 1"),
        ({"render_mode": "XYZ"}, "unknown render_mode 'XYZ'"),
        ({"sparse_grad": True}, "needs packed=True"),
        ({"background": torch.zeros(4)}, r"background must be \[3\]"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            Rasterizer(**options)
