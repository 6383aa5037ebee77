"""Cut Gaussians: the implicit form of Bézier curves, the gradient of its sign, and rendering."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsplat_core.choices import KERNELS
from gsplat_core.errors import InvalidInput
from gsplat_core.experimental.cut_gaussians import (
    CURVES,
    SMALLEST_FLIP,
    implicit_form,
    projected_curves,
    render_kernel,
    side,
    with_curves,
)
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians


def random_curves(count):
    return torch.randn(count, 4, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def points_on(curves, t):
    bases = torch.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], -1)
    return torch.einsum("tk,nkc->ntc", bases, curves)


def splats(count=40, size=40):
    g = torch.Generator().manual_seed(3)
    means = torch.cat([torch.rand(count, 2, generator=g) * size, 10 + torch.rand(count, 1, generator=g)], 1)
    scales = torch.tensor([4.0, 3.0, 0.1]).log().repeat(count, 1)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1) * torch.tensor([1.0, 0, 0, 1.0])
    quats[:, 0] += 0.1
    return Gaussians(means, quats, scales, torch.randn(count, generator=g), torch.rand(count, 1, 3, generator=g))


@pytest.fixture
def camera():
    return Camera(np.eye(3), 40, 40, model="ortho")


def test_points_of_a_curve_are_zeros_of_its_implicit_form():
    curves = random_curves(20)
    on = points_on(curves, torch.linspace(0, 1, 7, dtype=torch.float64))
    value, slopes = implicit_form(on, curves[:, None])
    off = implicit_form(on + 0.3, curves[:, None]).value
    assert float(value.abs().max()) < 1e-9 * float(off.abs().max())
    assert slopes.shape == (20, 7, 4, 2)


def test_slopes_are_those_of_autograd():
    curves = random_curves(20).requires_grad_()
    points = torch.randn(20, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    value, slopes = implicit_form(points, curves)
    (wanted,) = torch.autograd.grad(value.sum(), curves)
    torch.testing.assert_close(slopes.detach(), wanted)


def test_the_gradient_moves_the_curve_over_the_point():
    curves = random_curves(200).requires_grad_()
    points = points_on(curves.detach(), torch.tensor([0.5], dtype=torch.float64))[:, 0] + 0.02
    before = side(points, curves)
    # A loss that is less on the other side.
    gradient = 2 * before.detach() - 1
    (slope,) = torch.autograd.grad((before * gradient).sum(), curves)
    changed = slope.flatten(1)
    assert ((changed != 0).sum(1) <= 1).all()
    assert float(changed.abs().max()) <= 1 / SMALLEST_FLIP + 1e-9
    found = changed.abs().amax(1) > 0
    assert found.float().mean() > 0.9
    moved = curves.detach() - 0.1 * slope.sign()
    flipped = side(points, moved) != before.detach()
    assert flipped[found].float().mean() > 0.85


def test_the_gaussian_kernel_gives_the_picture_of_alpha_blending(camera, device):
    scene = splats().to(device)
    background = torch.tensor([0.2, 0.4, 0.6], device=device)
    found = render_kernel(scene, camera, KERNELS["gaussian"](), background)
    torch.testing.assert_close(found, render(scene, camera, background).image, rtol=1e-4, atol=1e-4)


def test_curves_far_away_cut_nothing_and_near_ones_cut_their_part(camera, device):
    scene = splats().to(device)
    g = torch.Generator().manual_seed(5)
    whole = render_kernel(scene, camera, KERNELS["gaussian"]())
    far = render_kernel(with_curves(scene, 2, g, distance=50.0), camera, KERNELS["cut"]())
    torch.testing.assert_close(far, whole)
    near = with_curves(scene, 2, g, distance=0.5)
    near.requires_grad_()
    cut = render_kernel(near, camera, KERNELS["cut"]())
    assert 0.1 < float(cut.detach().sum() / whole.sum()) < 0.95
    cut.square().mean().backward()
    assert all(t.grad.isfinite().all() and t.grad.abs().sum() > 0 for t in (near.extra[CURVES], near.means))


def test_one_straight_edge_shows_where_it_is_projected():
    camera = Camera.from_focal(40.0, 32, 32)
    scene = Gaussians(
        torch.tensor([[0.0, 0, 20]]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[6.0, 6, 0.1]]).log(),
        torch.tensor([6.0]), torch.full((1, 1, 3), 1.0),
    )  # fmt: skip
    # The cubic y = x^3 / 30 in standard deviations, nearly the horizontal axis.
    x = torch.tensor([-3.0, -1, 1, 3])
    curve = torch.stack([x, torch.tensor([-0.9, 0.9, -0.9, 0.9])], 1)[None, None]
    shown = []
    for points in (curve, curve.flip(2)):
        cut = Gaussians(**{**scene.tensors(), "extra": {CURVES: points}})
        assert projected_curves(cut, camera, torch.tensor([[16.0, 16]])).abs().max() == pytest.approx(36, rel=1e-4)
        shown.append(render_kernel(cut, camera, KERNELS["cut"]())[..., 0])
    whole = render_kernel(scene, camera, KERNELS["gaussian"]())[..., 0]
    torch.testing.assert_close(shown[0] + shown[1], whole)
    halves = [float(part[:12].sum() / whole[:12].sum()) for part in shown]
    assert sorted(round(share) for share in halves) == [0, 1]
    assert math.isclose(sum(halves), 1, rel_tol=1e-4)


def test_wrong_arguments_are_refused(camera):
    with pytest.raises(InvalidInput, match="needs Gaussians with curves"):
        render_kernel(splats(), camera, KERNELS["cut"]())
    with pytest.raises(InvalidInput, match="fisheye"):
        render_kernel(splats(), Camera(np.eye(3), 40, 40, model="fisheye"), KERNELS["gaussian"]())
