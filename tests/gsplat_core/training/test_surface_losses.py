"""Losses of ray depth and normals: their values on exact walls, and their effect on displaced and turned Gaussians."""

import math
from dataclasses import replace

import pytest
import torch

from gsplat_core import Camera, Gaussians
from gsplat_core.rendering.surface import view_of
from gsplat_core.training.losses import (
    EVERY,
    LossContext,
    NormalConsistency,
    RayDepth,
    WeightedLosses,
    compared_rays,
    rays_of,
)
from gsplat_core.training.observations import Observation

SMALL, LARGE = (90, 74), (256, 200)


def wall(tilt_deg: float, distance: float = 40.0) -> Gaussians:
    """Flat Gaussians on a plane through (0, 0, distance), turned around y."""
    angle = math.radians(tilt_deg)
    a, b = torch.meshgrid(torch.arange(-40.0, 41), torch.arange(-30.0, 31), indexing="xy")
    a, b = a.ravel(), b.ravel()
    means = torch.stack([a * math.cos(angle), b, distance + a * math.sin(angle)], 1)
    quats = torch.tensor([math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0]).repeat(len(means), 1)
    scales = torch.tensor([0.8, 0.8, 0.02]).log().repeat(len(means), 1)
    return Gaussians(means, quats, scales, torch.full((len(means),), 3.0), torch.zeros(len(means), 1, 3))


def observation(size, tilt_deg=0.0, distance=40.0) -> Observation:
    camera = Camera.from_focal(1.2 * size[0], *size)
    x = (torch.arange(size[0]) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    depth = (distance / (1 - math.tan(math.radians(tilt_deg)) * x)).expand(size[1], -1).float().contiguous()
    image = torch.zeros(size[1], size[0], 3, dtype=torch.uint8)
    return Observation(0, 0.0, camera, image, torch.ones(size[1], size[0], dtype=torch.uint8), depth)


def compared(kind, scene: Gaussians, seen: Observation) -> torch.Tensor:
    return kind().compare(rays_of(scene, seen))


@pytest.mark.parametrize("size", [SMALL, LARGE])
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
def test_surface_losses_of_exact_wall_are_zero(size, tilt_deg):
    scene = wall(tilt_deg)
    assert float(compared(RayDepth, scene, observation(size, tilt_deg))) < 5e-4
    assert float(compared(NormalConsistency, scene, observation(size, tilt_deg))) < 2e-3


def test_ray_depth_loss_of_displaced_wall_moves_wall_back():
    scene = wall(0.0, 44.0).requires_grad_()
    loss = compared(RayDepth, scene, observation(SMALL))
    loss.backward()
    loss = loss.detach()
    assert float(loss) == pytest.approx(1 - 40 / 44, rel=1e-3)
    moved = replace(scene.detach(), means=scene.means.detach() - 100 * scene.means.grad)
    assert float(scene.means.grad[:, 2].sum()) > 0
    assert float(compared(RayDepth, moved, observation(SMALL))) < float(loss)


def test_normal_consistency_loss_turns_splats_back():
    scene = wall(0.0)
    turn = torch.tensor([math.cos(0.2), math.sin(0.2), 0.0, 0.0]).repeat(scene.count, 1)
    scene = replace(scene, quats=turn)
    before = None
    for _ in range(30):
        scene = scene.detach().requires_grad_()
        loss = compared(NormalConsistency, scene, observation(SMALL))
        loss.backward()
        loss = loss.detach()
        before = float(loss) if before is None else before
        scene = replace(scene, quats=scene.quats - 3e-3 * scene.quats.grad.sign())
    assert before == pytest.approx(1 - math.cos(0.4), rel=0.3)
    assert float(loss) < 0.4 * before


def test_surface_losses_ignore_tools_and_unknown_depth():
    scene = wall(0.0, 44.0)
    seen = observation(SMALL)
    masked = replace(seen, mask=torch.zeros_like(seen.mask))
    assert float(compared(RayDepth, scene, masked)) == 0
    assert float(compared(NormalConsistency, wall(30.0), masked)) == 0
    assert float(compared(RayDepth, scene, replace(seen, depth=torch.zeros_like(seen.depth)))) == 0


def test_weighted_losses_without_depth_skip_depth_losses():
    scene, seen = wall(30.0), replace(observation(SMALL), depth=None)
    context = LossContext((), lambda _: scene)
    assert WeightedLosses({"ray_depth": 1.0})(scene, seen, context) is None
    both = WeightedLosses({"ray_depth": 1.0, "normal_consistency": 0.5})(scene, seen, context)
    torch.testing.assert_close(both, EVERY * 0.5 * compared(NormalConsistency, scene, seen))


def test_weighted_losses_compare_rays_every_few_steps():
    losses, scene, seen = WeightedLosses({"ray_depth": 2.0}), wall(0.0, 44.0), observation(SMALL)
    values = [losses(scene, seen, LossContext((), lambda _: scene)) for _ in range(2 * EVERY)]
    assert [value is not None for value in values] == 2 * [True, *[False] * (EVERY - 1)]
    assert float(values[0]) == pytest.approx(EVERY * 2 * (1 - 40 / 44), rel=1e-3)


@pytest.mark.parametrize("size", [SMALL, LARGE])
def test_compared_rays_with_fixed_capacity_are_identical(size):
    """Tile lists of a captured step: equal values, and the required length."""
    seen = observation(size, 30.0)
    results = []
    for capacity in (None, 1 << 15):
        scene = wall(20.0, 41.0).requires_grad_()
        view = view_of(seen.camera, scene.device)
        rays, needed = compared_rays(scene, view, seen.mask, seen.depth, capacity=capacity)
        losses = WeightedLosses({"ray_depth": 2.0, "normal_consistency": 1.0})
        loss = losses.compare(rays)
        loss.backward()
        assert (needed is None) == (capacity is None)
        results.append([loss.detach(), scene.means.grad, scene.quats.grad, scene.log_scales.grad])
    assert 0 < int(needed) < 1 << 15
    for exact, fixed in zip(*results, strict=True):
        assert torch.equal(exact, fixed)
        assert exact.abs().sum() > 0
    *_, needed_again = compared_rays(wall(20.0, 41.0), view, seen.mask, seen.depth, capacity=100)
    assert torch.equal(needed_again, needed)


def test_surface_losses_compare_large_pictures_at_half_size():
    seen = observation(LARGE, 30.0)
    rays = rays_of(wall(30.0), seen)
    assert rays.alphas.shape == (LARGE[1] // 2, LARGE[0] // 2)
    inner = (slice(20, -20), slice(20, -20))
    off = (rays.depths / rays.sampled(seen.depth) - 1).abs()[inner]
    assert float(off.max()) < 1e-3
