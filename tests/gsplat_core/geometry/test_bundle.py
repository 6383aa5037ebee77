"""Bundle adjustment against scenes whose cameras and points are known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core.poses.bundle import Bundle, adjust, errors_px
from gsplat_core.poses.se3 import exp, inverse

FOCAL = 300.0


def known_scene(cameras: int = 8, points: int = 60, seed: int = 0) -> Bundle:
    """Cameras that go round a lumpy surface, each of which sees all of it."""
    random = torch.Generator().manual_seed(seed)
    where = torch.rand(points, 3, generator=random, dtype=torch.float64) * torch.tensor(
        [40.0, 30.0, 8.0]
    ) + torch.tensor([-20.0, -15, 50])
    share = torch.linspace(0, 1, cameras, dtype=torch.float64)[:, None]
    poses = exp(share * torch.tensor([[8.0, -3.0, 4.0, 0.05, 0.1, -0.08]], dtype=torch.float64))
    camera = torch.arange(cameras).repeat_interleave(points)
    point = torch.arange(points).repeat(cameras)
    local = (poses[camera, :3, :3] @ where[point][:, :, None])[:, :, 0] + poses[camera, :3, 3]
    return Bundle(poses, where, camera, point, local[:, :2] / local[:, 2:], FOCAL)


def disturbed(scene: Bundle, size: float = 0.02) -> Bundle:
    random = torch.Generator().manual_seed(7)
    twist = size * torch.randn(len(scene.poses), 6, generator=random, dtype=torch.float64)
    twist[0] = 0
    off = 20 * size * torch.randn(scene.points.shape, generator=random, dtype=torch.float64)
    return replace(scene, poses=exp(twist) @ scene.poses, points=scene.points + off)


def first_only(scene: Bundle) -> torch.Tensor:
    fixed = torch.zeros(len(scene.poses), dtype=torch.bool)
    fixed[0] = True
    return fixed


def way_off(found: Bundle, true: Bundle) -> float:
    """Largest distance between the cameras' centres, after the one scale that nothing tells."""
    ours, theirs = (inverse(bundle.poses)[:, :3, 3] for bundle in (found, true))
    scale = (ours * theirs).sum() / (ours * ours).sum()
    return float((scale * ours - theirs).norm(dim=1).max())


def test_a_scene_without_noise_is_found_again():
    true = known_scene()
    start = disturbed(true)
    assert float(errors_px(start).median()) > 2
    found = adjust(start, fixed=first_only(true), rounds=60)
    assert float(errors_px(found).max()) < 1e-3
    assert way_off(found, true) < 0.01
    assert torch.equal(found.poses[0], true.poses[0])


def test_points_that_move_by_themselves_decide_little():
    true = known_scene()
    random = torch.Generator().manual_seed(3)
    rays = true.rays.clone()
    astray = true.point < 12
    rays[astray] += 20 / FOCAL * torch.randn(int(astray.sum()), 2, generator=random, dtype=torch.float64)
    start = disturbed(replace(true, rays=rays), 0.01)
    found = adjust(start, fixed=first_only(true), rounds=60)
    least_squares = adjust(start, fixed=first_only(true), rounds=60, spread_px=1e6)
    assert way_off(found, true) < 0.5 and way_off(found, true) < 0.2 * way_off(least_squares, true)
    assert float(errors_px(found)[~astray].median()) < 0.3


def test_cameras_alone_are_placed_before_known_points():
    true = known_scene()
    start = replace(disturbed(true), points=true.points)
    found = adjust(start, fixed=first_only(true), rounds=20, points_move=False)
    torch.testing.assert_close(found.poses, true.poses, atol=1e-6, rtol=0)
    assert torch.equal(found.points, true.points)


@pytest.mark.parametrize("points_move", [True, False])
def test_a_step_never_makes_it_worse(points_move):
    true = known_scene(cameras=4, points=12)
    bundle = disturbed(true, 0.1)
    before = float(torch.log1p(errors_px(bundle).square()).sum())
    for _ in range(5):
        bundle = adjust(bundle, fixed=first_only(true), rounds=1, points_move=points_move)
        cost = float(torch.log1p(errors_px(bundle).square()).sum())
        assert cost <= before
        before = cost


def test_a_point_behind_a_camera_is_finite():
    true = known_scene(cameras=3, points=30)
    points = true.points.clone()
    points[0, 2] = -5
    found = adjust(replace(true, points=points), fixed=first_only(true))
    assert torch.isfinite(found.points).all() and torch.isfinite(found.poses).all()
    assert float(errors_px(found)[true.point != 0].max()) < 1
