"""Cut Gaussians: the implicit form of Bézier curves, the signed distance from them, and rendering."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.choices import KERNELS
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.experimental import cut_gaussians
from gsplat_core.experimental.cut_gaussians import (
    CURVES,
    implicit_form,
    projected_curves,
    render_kernel,
    signed_distance,
    with_curves,
)
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians


def random_curves(count):
    return torch.randn(count, 4, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def bernstein(t):
    return torch.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], -1)


def points_on(curves, t):
    return torch.einsum("tk,nkc->ntc", bernstein(t), curves)


def reference_distance(points, curves, count=20001):
    """Distance by exhaustive search over points of the curves and of the tangents beyond their ends, with the sign of the
    side of the tangent at the nearest point.
    """
    t = torch.linspace(0, 1, count, dtype=torch.float64)
    before, beyond = (100 * t.flip(0) ** 4, 100 * t**4)
    ends = [3 * (curves[:, 1] - curves[:, 0]), 3 * (curves[:, 3] - curves[:, 2])]
    parts = [
        curves[:, None, 0] - before[:, None] * ends[0][:, None],
        points_on(curves, t),
        curves[:, None, 3] + beyond[:, None] * ends[1][:, None],
    ]
    along = torch.cat(parts, 1)
    gap = (along - points[:, None]).norm(dim=-1)
    least, at = gap.min(1)
    rows = torch.arange(len(points))
    tangent = along[rows, (at + 1).clamp(max=along.shape[1] - 1)] - along[rows, (at - 1).clamp(min=0)]
    off = points - along[rows, at]
    return least * (tangent[:, 0] * off[:, 1] - tangent[:, 1] * off[:, 0]).sign()


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


def test_implicit_form_zero_on_curve():
    curves = random_curves(20)
    on = points_on(curves, torch.linspace(0, 1, 7, dtype=torch.float64))
    value = implicit_form(on, curves[:, None])
    off = implicit_form(on + 0.3, curves[:, None])
    assert value.shape == (20, 7)
    assert float(value.abs().max()) < 1e-9 * float(off.abs().max())


def test_signed_distance_of_straight_curve_independent_of_spacing():
    x = torch.tensor([[-3.0, -1.2, 1, 3], [-3, -1, 1, 3], [-3, -0.8, 1, 3]], dtype=torch.float64)
    lines = torch.stack([x, torch.zeros_like(x)], -1)
    point = torch.tensor([0.3, 1.0], dtype=torch.float64)
    assert implicit_form(point, lines).sign().tolist() == [-1, 0, 1]
    torch.testing.assert_close(signed_distance(point, lines), torch.ones(3, dtype=torch.float64))


def test_signed_distance_equals_exhaustive_search(monkeypatch):
    curves = random_curves(200)
    points = 2 * torch.randn(200, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    wanted = reference_distance(points, curves)
    found = signed_distance(points, curves)
    # A point that is about equally far from two parts of a curve may be assigned to either.
    assert float((found.abs() - wanted.abs()).abs().max()) < 0.05
    assert ((found - wanted).abs() < 2e-3).float().mean() > 0.97
    single = signed_distance(points.float(), curves.float())
    assert ((single - found).abs() < 1e-3).float().mean() > 0.97
    monkeypatch.setattr(cut_gaussians, "CHORDS", 16)
    torch.testing.assert_close(signed_distance(points, curves).abs(), wanted.abs(), atol=1e-3, rtol=0)


def test_signed_distance_zero_on_curve_and_end_tangents(monkeypatch):
    curves = random_curves(20)
    on = points_on(curves, torch.linspace(0, 1, 7, dtype=torch.float64))
    beyond = [curves[:, 3] + 2 * (curves[:, 3] - curves[:, 2]), curves[:, 0] + 2 * (curves[:, 0] - curves[:, 1])]
    on = torch.cat([on, torch.stack(beyond, 1)], 1)
    monkeypatch.setattr(cut_gaussians, "REFINEMENTS", 8)
    assert float(signed_distance(on, curves[:, None]).abs().max()) < 1e-9


def test_signed_distance_passes_gradcheck(monkeypatch):
    monkeypatch.setattr(cut_gaussians, "REFINEMENTS", 40)
    curves = random_curves(20).requires_grad_()
    points = torch.randn(20, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(signed_distance, (points, curves))
    assert torch.autograd.gradcheck(signed_distance, (points[:3, None], curves[None, :4]))


def test_signed_distance_gradient_accurate_with_default_refinements():
    curves = random_curves(200).requires_grad_()
    points = torch.randn(200, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    (found,) = torch.autograd.grad(signed_distance(points, curves).sum(), curves)
    step = 1e-6
    moved = (signed_distance(points, curves + step) - signed_distance(points, curves - step)) / (2 * step)
    error = (found.sum((1, 2)) - moved.detach()).abs()
    assert float(error.median()) < 1e-6 and (error < 1e-2).float().mean() > 0.97


@pytest.mark.parametrize(
    ("x", "y"),
    [
        ([-3.0, -1, 1, 3], [0.0, 0, 0, 0]), ([-3.0, -3, 3, 3], [0.0, 0, 0, 0]), ([0.0, 0, 0, 1], [0.0, 0, 0, 0]),
        ([-1.0, -1, -1, 5], [0.0, 0, 0, 0]), ([-1.0, 4, -4, 3], [0.0, 0, 0, 0]), ([-1e-3, 0, 0, 1e-3], [0.0, 0, 0, 0]),
        ([-1e4, -1e3, 1e3, 1e4], [0.0, 0, 0, 0]), ([-3.0, -1, 1, 3], [1e-6, -1e-6, 1e-6, 0]),
    ],
)  # fmt: skip
def test_signed_distance_of_straight_curves_equals_distance_from_line(x, y):
    curve = torch.tensor([x, y]).T.requires_grad_()
    points = torch.tensor([[0.1, 0.5], [0.1, -0.5], [40.0, 7], [-40.0, -7], [0.0, 0]], requires_grad=True)
    found = signed_distance(points, curve)
    torch.testing.assert_close(found, points[:, 1].detach(), atol=2e-3, rtol=1e-3)
    found.sum().backward()
    torch.testing.assert_close(points.grad, torch.tensor([0.0, 1.0]).expand(5, 2), atol=1e-2, rtol=0)
    assert curve.grad.isfinite().all()
    # A shift of all control points by the normal moves the line by as much.
    assert float(curve.grad[:, 1].sum()) == pytest.approx(-5, rel=1e-3)


@pytest.mark.parametrize(
    "curve",
    [
        torch.zeros(4, 2), torch.tensor([[0.0, 0], [2, 2], [0, 2], [2, 0]]), torch.tensor([[0.0, 0], [3, 1], [-3, 1], [0, 0]]),
        torch.tensor([[0.0, 0], [0, 0], [1, 1], [1, 1]]), torch.tensor([[0.0, 0], [1, 0], [0, 0], [1, 0]]),
        1e6 + torch.tensor([[0.0, 0], [1, 0], [2, 1], [3, 1]]),
    ],
    ids=["point", "cusp", "loop", "double ends", "back and forth", "far away"],
)  # fmt: skip
def test_signed_distance_of_degenerate_curves_is_finite(curve):
    curve = curve.clone().requires_grad_()
    side = torch.linspace(-4, 4, 41)
    points = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1).requires_grad_()
    found = signed_distance(points, curve)
    found.sum().backward()
    assert found.isfinite().all() and curve.grad.isfinite().all() and points.grad.isfinite().all()
    nearest = (
        points_on(curve[None].double(), torch.linspace(0, 1, 2001).double()) - points.detach()[..., None, :]
    ).norm(dim=-1)
    assert (found.abs() <= nearest.amin(-1) + 0.1).all()


def test_gaussian_kernel_equals_alpha_blending(camera, device):
    scene = splats().to(device)
    background = torch.tensor([0.2, 0.4, 0.6], device=device)
    found = render_kernel(scene, camera, KERNELS["gaussian"](), background)
    torch.testing.assert_close(found, render(scene, camera, background).image, rtol=1e-4, atol=1e-4)


def test_cut_kernel_far_curves_cut_nothing_and_near_curves_cut_part(camera, device):
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


def test_cut_kernel_straight_edge_at_projected_position():
    camera = Camera.from_focal(40.0, 32, 32)
    scene = Gaussians(
        torch.tensor([[0.0, 0, 20]]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[6.0, 6, 0.1]]).log(),
        torch.tensor([6.0]), torch.full((1, 1, 3), 1.0),
    )  # fmt: skip
    curve = torch.tensor([[-3.0, 0], [-1, 0], [1, 0], [3, 0]])[None, None]
    whole = render_kernel(scene, camera, KERNELS["gaussian"]())[..., 0]
    shown = []
    for points in (curve, curve.flip(2)):
        cut = replace(scene, extra={CURVES: points})
        assert (projected_curves(cut, camera) - 16).abs().max() == pytest.approx(36, rel=1e-4)
        shown.append(render_kernel(cut, camera, KERNELS["cut"]())[..., 0])
    torch.testing.assert_close(shown[0] + shown[1], whole, rtol=2e-2, atol=0)
    # Rows are whole pixels from the edge less a half; the share there is that of the logistic function.
    for row, distance in ((15, -0.5), (16, 0.5), (17, 1.5), (19, 3.5)):
        assert float(shown[0][row, 16] / whole[row, 16]) == pytest.approx(1 / (1 + math.exp(-4 * distance)), abs=2e-3)
    wide = render_kernel(replace(scene, extra={CURVES: curve}), camera, KERNELS["cut"](width_px=4.0))[..., 0]
    assert float(wide[17, 16] / whole[17, 16]) == pytest.approx(1 / (1 + math.exp(-1.5)), abs=2e-3)


@pytest.mark.parametrize("model", ["pinhole", "ortho"])
def test_cut_kernel_shows_same_part_from_front_and_back(model):
    g = torch.Generator().manual_seed(6)
    scene = with_curves(
        Gaussians(
            torch.tensor([[0.0, 0, 0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[6.0, 4, 0.1]]).log(),
            torch.tensor([6.0]), torch.full((1, 1, 3), 1.0),
        ),
        2, g, 0.3,
    )  # fmt: skip
    front, back = np.eye(4), np.diag([-1.0, 1, -1, 1])
    front[2, 3] = back[2, 3] = 40
    K = np.array(
        [[40.0 if model == "pinhole" else 1.0, 0, 16], [0, 40.0 if model == "pinhole" else 1.0, 16], [0, 0, 1]]
    )
    shown = [
        render_kernel(scene, Camera(K, 32, 32, world_to_camera=view, model=model), KERNELS["cut"]())
        for view in (front, back)
    ]
    assert float(shown[0].max()) > 0.5
    torch.testing.assert_close(shown[0].flip(1), shown[1], rtol=1e-3, atol=1e-4)


def test_cut_kernel_image_gradient_equals_finite_differences(camera):
    scene = with_curves(splats(count=3), 2, torch.Generator().manual_seed(5), distance=0.5)
    scene.requires_grad_()
    kernel = KERNELS["cut"](width_px=2.0)
    weights = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(1))

    def total():
        return (render_kernel(scene, camera, kernel) * weights).sum()

    total().backward()
    for tensor, step in ((scene.extra[CURVES], 3e-3), (scene.means, 1e-2), (scene.log_scales, 3e-3)):
        direction = tensor.grad / tensor.grad.norm()
        with torch.no_grad():
            tensor += step * direction
            ahead = float(total())
            tensor -= 2 * step * direction
            slope = (ahead - float(total())) / (2 * step)
            tensor += step * direction
        assert slope == pytest.approx(float(tensor.grad.norm()), rel=0.05)


def test_cut_kernel_optimisation_moves_curve_to_image_edge():
    camera = Camera(np.eye(3), 32, 32, model="ortho")
    wanted = torch.zeros(32, 32, 3)
    wanted[:, :11] = 1
    wanted[:, 11] = 0.5
    scene = Gaussians(
        torch.tensor([[16.0, 16, 5]]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[60.0, 60, 1]]).log(),
        torch.tensor([8.0]), torch.full((1, 1, 3), 0.5 / 0.28209479),
    )  # fmt: skip
    curve = torch.tensor([[[[0.1, -0.3], [0.05, -0.1], [0.02, 0.1], [0.0, 0.3]]]], requires_grad=True)
    optimiser = torch.optim.Adam([curve], lr=5e-3)
    for step in range(150):
        kernel = KERNELS["cut"](width_px=max(1.0, 8 - 0.1 * step))
        loss = (render_kernel(replace(scene, extra={CURVES: curve}), camera, kernel) - wanted).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    # The edge at x = 11.5 pixels.
    at = projected_curves(replace(scene, extra={CURVES: curve}), camera).detach()[0, 0]
    assert signed_distance(torch.tensor([[11.5, 4], [11.5, 16], [11.5, 28]]), at).abs().max() < 0.5
    assert float(loss.detach()) < 2e-3


@pytest.mark.parametrize("kernel", [*KERNELS])
def test_render_kernel_without_gaussians_shows_background(camera, kernel):
    empty = with_curves(splats().select(slice(0)), 1, torch.Generator())
    background = torch.tensor([0.2, 0.5, 0.7])
    picture = render_kernel(empty, camera, KERNELS[kernel](), background)
    assert torch.equal(picture, background.expand(camera.height_px, camera.width_px, 3))


def test_render_kernel_rejects_invalid_arguments(camera):
    with pytest.raises(InvalidInput, match="needs Gaussians with curves"):
        render_kernel(splats(), camera, KERNELS["cut"]())
    with pytest.raises(InvalidInput, match="fisheye"):
        render_kernel(splats(), Camera(np.eye(3), 40, 40, model="fisheye"), KERNELS["gaussian"]())
    with pytest.raises(InvalidSetting, match="width_px is 0"):
        KERNELS["cut"](width_px=0)
