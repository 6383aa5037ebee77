"""Motion of the surface from flow, and depth of the scene from given camera motion."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from gsplat_core.deformation import BasisField
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.image_motion import Seen, SurfaceMotion
from gsplat_core.training.motion_prior import DepthFromMotion, inverse_depths
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


def test_surface_motion_of_static_scene_is_zero() -> None:
    after = moved_camera(x=0.05, z=0.1, turned=0.02)
    depth = torch.full((32 * 40,), 2.0)
    points = on_depth(grid_pixels(), depth)
    motion = SurfaceMotion(flow_of_static(depth, after), FIRST, after)
    inside = Seen(after, points).inside[:, 0] & (grid_pixels() > 8).all(1) & (grid_pixels() < 120).all(1)
    assert motion.ahead(points)[inside].norm(dim=1).max() < 2e-3
    assert motion.arrived(points)[inside].norm(dim=1).max() < 2e-3


def test_surface_motion_of_still_camera_is_parallel_to_picture() -> None:
    motion = SurfaceMotion(torch.tensor([3.0, -1.0]).expand(32, 40, 2), FIRST, FIRST)
    points = on_depth(torch.tensor([[60.0, 50.0], [500.0, 50.0]]), torch.tensor([7.0, 7.0]))
    expected = torch.tensor([[3.0, -1.0, 0.0]]) * 7 / 140
    torch.testing.assert_close(motion.ahead(points)[:1], expected)
    torch.testing.assert_close(motion.arrived(points)[:1], expected)
    assert not motion.ahead(points)[1].any()  # outside of the picture


def test_depth_from_motion_finds_plane_distance_and_keeps_first_view() -> None:
    step, after = plane_at(60.0), moved_camera(x=0.06, z=0.02, turned=0.01)
    step.field.weights.data[..., :3].fill_(0.01)  # type: ignore[union-attr, index]
    pixels_before = Seen(FIRST, step.at(0.5).means).pixels
    DepthFromMotion().apply(step, SurfaceMotion(flow_of_static(torch.full((1280,), 1.6), after), FIRST, after), 0.5)
    scene = step.at(0.5)
    assert abs(float(scene.means[:, 2].median()) - 1.6) < 0.05
    torch.testing.assert_close(Seen(FIRST, scene.means).pixels, pixels_before, rtol=1e-3, atol=0.05)
    assert abs(float(scene.log_scales.mean()) - np.log(1.6 / 60)) < 0.1


def test_depth_from_motion_refines_relief_with_further_frames() -> None:
    x = grid_pixels()[:, 0] / WIDTH
    depth = 1.5 + 0.4 * torch.sin(6 * x)
    step, after, prior = plane_at(60.0), moved_camera(x=0.1), DepthFromMotion()
    for _ in range(6):
        prior.apply(step, SurfaceMotion(flow_of_static(depth, after), FIRST, after), 0.5)
    inside = (grid_pixels()[:, 0] > 16) & (grid_pixels()[:, 0] < WIDTH - 16)
    error = (step.at(0.5).means[:, 2] - depth).abs()[inside]
    assert float(error.median()) < 0.05


@pytest.mark.parametrize("after", [FIRST, moved_camera(turned=0.03), moved_camera(x=1e-4)])
def test_depth_from_motion_without_parallax_changes_nothing(after: Camera) -> None:
    step = plane_at(60.0)
    before = step.gaussians.means.clone()
    DepthFromMotion().apply(step, SurfaceMotion(flow_of_static(torch.full((1280,), 1.6), after), FIRST, after), 0.5)
    assert torch.equal(step.gaussians.means, before)


def test_depth_from_motion_ignores_inconsistent_flow() -> None:
    step, after = plane_at(60.0), moved_camera(x=0.06)
    before = step.gaussians.means.clone()
    flow = torch.from_numpy(np.random.default_rng(0).normal(0, 6, (32, 40, 2)).astype(np.float32))
    DepthFromMotion().apply(step, SurfaceMotion(flow, FIRST, after), 0.5)
    assert torch.equal(step.gaussians.means, before)
    DepthFromMotion().apply(step, SurfaceMotion(flow * np.nan, FIRST, after), 0.5)
    assert step.gaussians.means.isfinite().all()


def seen_after(after: Camera, depth: Tensor) -> tuple[Tensor, Tensor]:
    pixels = grid_pixels()
    return pixels, Seen(after, on_depth(pixels, depth)).pixels


@pytest.mark.parametrize("after", [moved_camera(3.0), moved_camera(0.0, 4.0), moved_camera(2.0, 3.0, 0.03)])
def test_inverse_depths_and_information_match_parallax(after: Camera) -> None:
    """Information is the square of the pixels by which the point moves per inverse depth."""
    depth = torch.linspace(40, 90, len(grid_pixels()))
    pixels, target = seen_after(after, depth)
    inverse, information = inverse_depths(pixels, target, FIRST, after)
    step = 1e-4
    other = Seen(after, on_depth(pixels, 1 / (1 / depth + step))).pixels
    moves = (other - target).square().sum(1) / step**2
    good = moves > 0.01 * moves.median()
    torch.testing.assert_close(inverse[good], 1 / depth[good], rtol=2e-3, atol=0)
    # The equation is that of the point in units of its depth along the axis, which changes with the depth of the camera.
    ratio = (information[good] / moves[good]).sqrt()
    assert float(ratio.min()) > 0.85 and float(ratio.max()) < 1.2


def distance_of(after: Camera, depth: Tensor, target: Tensor | None = None, known: float = 1 / 60) -> float | None:
    pixels, seen = seen_after(after, depth)
    target = seen if target is None else target
    _, information = inverse_depths(pixels, target, FIRST, after)
    motion = SimpleNamespace(before=FIRST, after=after)
    return DepthFromMotion()._distance(pixels, target, motion, torch.full_like(depth, known), information)


@pytest.mark.parametrize("known", [1 / 600, 1 / 60, 1 / 6])
def test_plane_distance_is_independent_of_assumed_depth(known: float) -> None:
    depth = torch.full((len(grid_pixels()),), 50.0)
    assert distance_of(moved_camera(3.0), depth, known=known) == pytest.approx(50, rel=1e-3)


@pytest.mark.parametrize(("parallax_px", "is_found"), [(1.45, False), (1.55, True)])
def test_plane_distance_requires_1_5_pixels_of_parallax(parallax_px: float, is_found: bool) -> None:
    depth = torch.full((len(grid_pixels()),), 50.0)
    found = distance_of(moved_camera(parallax_px * 50 / 140), depth)
    assert found == (pytest.approx(50, rel=1e-3) if is_found else None)


def test_plane_distance_is_robust_to_independently_moving_points() -> None:
    depth = torch.full((len(grid_pixels()),), 50.0)
    _, target = seen_after(moved_camera(3.0), depth)
    moved = target.clone()
    moved[::5, 1] += 9.0
    assert distance_of(moved_camera(3.0), depth, moved) == pytest.approx(50, rel=0.01)
    opposite = target.clone()
    opposite[::5, 0] += 9.0
    assert distance_of(moved_camera(3.0), depth, opposite) == pytest.approx(50, rel=0.04)


@pytest.mark.parametrize(("share", "is_found"), [(0.9, True), (1.1, False)])
def test_plane_distance_requires_half_of_motion_explained(share: float, is_found: bool) -> None:
    """Motion along the rows is that of the plane; as much across them is not."""
    depth = torch.full((len(grid_pixels()),), 50.0)
    _, target = seen_after(moved_camera(3.0), depth)
    target[:, 1] += share * 3.0 * 140 / 50 * torch.where(torch.arange(len(target)) % 2 > 0, 1.0, -1.0)
    assert (distance_of(moved_camera(3.0), depth, target) is not None) == is_found


def test_plane_distance_is_none_behind_camera() -> None:
    depth = torch.full((len(grid_pixels()),), 50.0)
    pixels, target = seen_after(moved_camera(3.0), depth)
    assert distance_of(moved_camera(3.0), depth, 2 * pixels - target) is None
