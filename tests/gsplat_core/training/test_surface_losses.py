"""Losses of ray depth and normals: their values on exact walls, and their effect on displaced and turned Gaussians."""

import math
from dataclasses import replace

import pytest
import torch

from gsplat_core import Camera, Gaussians
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.losses.normal_consistency import NormalConsistency
from gsplat_core.training.losses.ray_depth import RayDepth
from gsplat_core.training.losses.rendered_rays import EVERY, rays_of
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


def context(scene: Gaussians) -> LossContext:
    return LossContext((), lambda _: scene)


@pytest.mark.parametrize("size", [SMALL, LARGE])
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
def test_an_exact_wall_has_no_loss(size, tilt_deg):
    scene = wall(tilt_deg)
    assert float(RayDepth()(scene, observation(size, tilt_deg), context(scene))) < 5e-4 * EVERY
    assert float(NormalConsistency()(scene, observation(size, tilt_deg), context(scene))) < 2e-3 * EVERY


def test_a_displaced_wall_has_the_relative_difference_and_is_moved_back():
    scene = wall(0.0, 44.0).requires_grad_()
    loss = RayDepth()(scene, observation(SMALL), context(scene))
    loss.backward()
    loss = loss.detach()
    assert float(loss) == pytest.approx(EVERY * (1 - 40 / 44), rel=1e-3)
    moved = replace(scene.detach(), means=scene.means.detach() - 25 * scene.means.grad)
    assert float(scene.means.grad[:, 2].sum()) > 0
    assert float(RayDepth()(moved, observation(SMALL), context(moved))) < float(loss)


def test_turned_splats_are_turned_back():
    scene = wall(0.0)
    turn = torch.tensor([math.cos(0.2), math.sin(0.2), 0.0, 0.0]).repeat(scene.count, 1)
    scene = replace(scene, quats=turn)
    before = None
    for _ in range(30):
        scene = scene.detach().requires_grad_()
        loss = NormalConsistency()(scene, observation(SMALL), context(scene))
        loss.backward()
        loss = loss.detach()
        before = float(loss) if before is None else before
        scene = replace(scene, quats=scene.quats - 3e-3 * scene.quats.grad.sign())
    assert before == pytest.approx(EVERY * (1 - math.cos(0.4)), rel=0.3)
    assert float(loss) < 0.4 * before


def test_tools_and_unknown_depth_are_not_compared():
    scene = wall(0.0, 44.0)
    seen = observation(SMALL)
    masked = replace(seen, mask=torch.zeros_like(seen.mask))
    assert float(RayDepth()(scene, masked, context(scene))) == 0
    assert float(NormalConsistency()(wall(30.0), masked, context(scene))) == 0
    assert float(RayDepth()(scene, replace(seen, depth=torch.zeros_like(seen.depth)), context(scene))) == 0
    assert RayDepth()(scene, replace(seen, depth=None), context(scene)) is None


def test_losses_of_one_step_render_once(monkeypatch):
    scene, shared = wall(0.0), context(wall(0.0))
    first = rays_of(scene, observation(SMALL), shared)
    assert rays_of(scene, observation(SMALL), shared) is first


def test_large_pictures_are_compared_at_half_size():
    seen = observation(LARGE, 30.0)
    rays = rays_of(wall(30.0), seen, context(wall(30.0)))
    assert rays.alphas.shape == (LARGE[1] // 2, LARGE[0] // 2)
    inner = (slice(20, -20), slice(20, -20))
    off = (rays.depths / rays.sampled(seen.depth) - 1).abs()[inner]
    assert float(off.max()) < 1e-3


@pytest.mark.parametrize("kind", [RayDepth, NormalConsistency])
def test_one_of_a_few_steps_is_evaluated(kind):
    loss, scene = kind(), wall(0.0)
    values = [loss(scene, observation(SMALL), context(scene)) for _ in range(2 * EVERY)]
    assert [value is not None for value in values] == 2 * [True, *[False] * (EVERY - 1)]
