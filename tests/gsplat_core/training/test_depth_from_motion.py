"""Motion of the surface from flow, and depth of the scene from given camera motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from gsplat_core.deformation import BasisField
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.motion.image_motion import Seen, SurfaceMotion
from gsplat_core.training.motion.prior import DepthFromMotion
from gsplat_core.training.steps.step import TrainingStep

WIDTH, HEIGHT = 160, 128
FIRST = Camera.from_focal(140.0, WIDTH, HEIGHT)


def moved_camera(x: float = 0.0, z: float = 0.0, turned: float = 0.0) -> Camera:
    pose = np.eye(4)
    c, s = np.cos(turned), np.sin(turned)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = [-x, 0, -z]
    return FIRST.with_pose(pose)


def grid_pixels() -> Tensor:
    """Centres of the flow's cells, [32 * 40, 2]."""
    y, x = torch.meshgrid(torch.arange(32) * 4 + 2.0, torch.arange(40) * 4 + 2.0, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def on_depth(pixels: Tensor, depth: Tensor) -> Tensor:
    """World points [N, 3] that FIRST sees at `pixels` and `depth` [N]."""
    plane = (pixels - torch.tensor([WIDTH / 2, HEIGHT / 2])) / 140.0
    return torch.cat([plane, torch.ones(len(plane), 1)], dim=1) * depth[:, None]


def flow_of_static(depth: Tensor, after: Camera) -> Tensor:
    """Flow [32, 40, 2] of a static scene of that depth at the cells' centres."""
    pixels = grid_pixels()
    return (Seen(after, on_depth(pixels, depth)).pixels - pixels).reshape(32, 40, 2)


def plane_at(depth: float) -> TrainingStep:
    pixels = grid_pixels()
    means = on_depth(pixels, torch.full((len(pixels),), depth))
    count = len(means)
    scene = Gaussians(
        means, torch.eye(4)[:1].repeat(count, 1), torch.full((count, 3), 0.0), torch.zeros(count),
        torch.zeros(count, 1, 3),
    )  # fmt: skip
    return TrainingStep(scene, BasisField(count, (0.0, 1.0), bumps=8), ReconstructorConfig(), FIRST)


def test_a_static_scene_of_the_right_depth_does_not_move() -> None:
    after = moved_camera(x=0.05, z=0.1, turned=0.02)
    depth = torch.full((32 * 40,), 2.0)
    points = on_depth(grid_pixels(), depth)
    motion = SurfaceMotion(flow_of_static(depth, after), FIRST, after)
    inside = Seen(after, points).inside[:, 0] & (grid_pixels() > 8).all(1) & (grid_pixels() < 120).all(1)
    assert motion.ahead(points)[inside].norm(dim=1).max() < 2e-3
    assert motion.arrived(points)[inside].norm(dim=1).max() < 2e-3


def test_flow_under_a_still_camera_is_motion_parallel_to_the_picture() -> None:
    motion = SurfaceMotion(torch.tensor([3.0, -1.0]).expand(32, 40, 2), FIRST, FIRST)
    points = on_depth(torch.tensor([[60.0, 50.0], [500.0, 50.0]]), torch.tensor([7.0, 7.0]))
    expected = torch.tensor([[3.0, -1.0, 0.0]]) * 7 / 140
    torch.testing.assert_close(motion.ahead(points)[:1], expected)
    torch.testing.assert_close(motion.arrived(points)[:1], expected)
    assert not motion.ahead(points)[1].any()  # outside of the picture


def test_the_distance_of_a_plane_is_found_and_the_first_view_kept() -> None:
    step, after = plane_at(60.0), moved_camera(x=0.06, z=0.02, turned=0.01)
    step.field.weights.data[..., :3].fill_(0.01)  # type: ignore[union-attr, index]
    pixels_before = Seen(FIRST, step.at(0.5).means).pixels
    DepthFromMotion().apply(step, SurfaceMotion(flow_of_static(torch.full((1280,), 1.6), after), FIRST, after), 0.5)
    scene = step.at(0.5)
    assert abs(float(scene.means[:, 2].median()) - 1.6) < 0.05
    torch.testing.assert_close(Seen(FIRST, scene.means).pixels, pixels_before, rtol=1e-3, atol=0.05)
    assert abs(float(scene.log_scales.mean()) - np.log(1.6 / 60)) < 0.1


def test_relief_is_refined_by_further_frames() -> None:
    x = grid_pixels()[:, 0] / WIDTH
    depth = 1.5 + 0.4 * torch.sin(6 * x)
    step, after, prior = plane_at(60.0), moved_camera(x=0.1), DepthFromMotion()
    for _ in range(6):
        prior.apply(step, SurfaceMotion(flow_of_static(depth, after), FIRST, after), 0.5)
    inside = (grid_pixels()[:, 0] > 16) & (grid_pixels()[:, 0] < WIDTH - 16)
    error = (step.at(0.5).means[:, 2] - depth).abs()[inside]
    assert float(error.median()) < 0.05


@pytest.mark.parametrize("after", [FIRST, moved_camera(turned=0.03), moved_camera(x=1e-4)])
def test_without_parallax_nothing_changes(after: Camera) -> None:
    step = plane_at(60.0)
    before = step.gaussians.means.clone()
    DepthFromMotion().apply(step, SurfaceMotion(flow_of_static(torch.full((1280,), 1.6), after), FIRST, after), 0.5)
    assert torch.equal(step.gaussians.means, before)


def test_motion_that_no_distance_explains_places_nothing() -> None:
    step, after = plane_at(60.0), moved_camera(x=0.06)
    before = step.gaussians.means.clone()
    flow = torch.from_numpy(np.random.default_rng(0).normal(0, 6, (32, 40, 2)).astype(np.float32))
    DepthFromMotion().apply(step, SurfaceMotion(flow, FIRST, after), 0.5)
    assert torch.equal(step.gaussians.means, before)
    DepthFromMotion().apply(step, SurfaceMotion(flow * np.nan, FIRST, after), 0.5)
    assert step.gaussians.means.isfinite().all()
