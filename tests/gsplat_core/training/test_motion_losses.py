"""Losses that compare several frames: optical flow, and points triangulated from several views."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core import Camera, Gaussians, render
from gsplat_core.errors import InvalidSetting
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.image_motion import consistent_flow
from gsplat_core.training.losses import LossContext
from gsplat_core.training.measured_losses import NOISE_PX, FlowLoss, TriangulationLoss, triangulate, triangulated
from gsplat_core.training.observations import Observation

CAMERA = Camera.from_focal(110.0, 96, 80)


def textured_wall(spacing: float = 0.7) -> Gaussians:
    """Opaque splats of random colours on a bumpy surface about 40 mm away."""
    a, b = torch.meshgrid(torch.arange(-28.0, 28, spacing), torch.arange(-24.0, 24, spacing), indexing="xy")
    a, b = a.ravel(), b.ravel()
    means = torch.stack([a, b, 40 + 1.5 * torch.sin(a / 5) * torch.cos(b / 6)], 1)
    count = len(means)
    colours = torch.randn(count, 1, 3, generator=torch.Generator().manual_seed(0))
    scales = torch.tensor([0.45, 0.45, 0.05]).log().repeat(count, 1)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return Gaussians(means, quats, scales, torch.full((count,), 4.0), colours)


def at(scene: Gaussians, means: torch.Tensor) -> Gaussians:
    return dataclasses.replace(scene, means=means)


def seen(scene: Gaussians, seq: int, camera: Camera = CAMERA) -> Observation:
    """Return the picture of a scene as an observation."""
    image = (render(scene, camera).image.clamp(0, 1) * 255).round().to(torch.uint8)
    return Observation(seq, seq / 10, camera, image, torch.ones(image.shape[:2], dtype=torch.uint8), None)


def test_consistent_flow_is_nan_for_inconsistent_or_masked_pixels():
    wall = textured_wall()
    first, second = seen(wall, 0).image.numpy(), seen(at(wall, wall.means + torch.tensor([0.9, 0, 0])), 1).image.numpy()
    flow = consistent_flow(first, second)
    inside = flow[8:-8, 8:-12]
    assert np.isfinite(inside).all(-1).mean() > 0.9
    assert abs(float(np.nanmedian(inside[..., 0])) - 0.9 / 40 * 110) < 0.1
    mask = np.ones(first.shape[:2], np.uint8)
    mask[:, :40] = 0
    assert np.isnan(consistent_flow(first, second, mask)[:, :40]).all()
    assert np.isnan(consistent_flow(first, second, None, mask)[20:60, :36]).all()
    noise = np.random.default_rng(0).integers(0, 255, first.shape, np.uint8)
    assert np.isfinite(consistent_flow(first, noise)).all(-1).mean() < 0.6
    assert np.isnan(consistent_flow(first[:40], second[:40])).all()


def test_flow_loss_gradient_moves_scene_along_flow():
    wall = textured_wall()
    shift = torch.tensor([0.9, -0.5, 0.0])
    frames = [seen(wall, 0), seen(at(wall, wall.means + shift), 1)]
    value = lambda means: FlowLoss()(at(wall, means), frames[1], LossContext(frames, lambda _: wall))
    still = wall.means.clone().requires_grad_()
    wrong = value(still)
    wrong.backward()
    right = value(wall.means + shift)
    expected = float(shift.norm()) / 40 * 110 - NOISE_PX
    assert abs(wrong.item() - expected) < 0.25 * expected and right.item() < 0.15 * wrong.item()
    along = (still.grad @ shift) / shift.norm()
    across = still.grad @ torch.tensor([0.5, 0.9, 0.0]) / shift.norm()
    assert float(along.sum()) < 0 and float(across.sum().abs()) < 0.2 * float(along.sum().abs())


def test_flow_loss_compares_large_pictures_at_half_size():
    wall = textured_wall()
    camera = Camera.from_focal(560.0, 480, 400)
    shift = torch.tensor([0.5, 0.0, 0.0])
    frames = [seen(wall, 0, camera), seen(at(wall, wall.means + shift), 1, camera)]
    value = FlowLoss()(wall, frames[1], LossContext(frames, lambda _: wall))
    assert abs(float(value) + NOISE_PX - 0.5 / 40 * 280) < 0.5


def test_flow_loss_does_not_penalise_the_noise_of_flow():
    wall = textured_wall()
    frames = [seen(wall, 0), seen(wall, 1)]
    near = (wall.means + torch.tensor([0.1, 0.0, 0.0])).requires_grad_()  # 0.3 px
    value = FlowLoss()(at(wall, near), frames[1], LossContext(frames, lambda _: wall))
    value.backward()
    assert value.item() == 0 and not near.grad.any()


def test_flow_loss_compares_with_both_neighbouring_frames_by_turns():
    wall = textured_wall()
    move = torch.tensor([0.6, 0.0, 0.0])
    frames = [seen(at(wall, wall.means + k * move), k) for k in range(3)]
    asked: list[float] = []

    def scene_at(time_s: float) -> Gaussians:
        asked.append(time_s)
        return at(wall, wall.means + round(time_s * 10) * move)

    loss, context = FlowLoss(), LossContext(frames, scene_at)
    exact = at(wall, wall.means + move)
    assert all(float(loss(exact, frames[1], context)) < 0.2 for _ in range(3))
    assert asked == [0.0, 0.2, 0.0]


def test_flow_loss_has_nothing_to_compare_alone_or_in_the_right_eye():
    wall = textured_wall()
    frame, other = seen(wall, 0), seen(wall, 1)
    assert FlowLoss()(wall, frame, LossContext([frame], lambda _: wall)) is None
    right = dataclasses.replace(frame, of_right=True)
    assert FlowLoss()(wall, right, LossContext([frame, other], lambda _: wall)) is None
    fisheye = dataclasses.replace(frame, camera=dataclasses.replace(CAMERA, model="fisheye"))
    with pytest.raises(InvalidSetting, match="for pinhole cameras, this one is fisheye"):
        FlowLoss()(wall, fisheye, LossContext([frame, other], lambda _: wall))


def around() -> list[Camera]:
    """Cameras beside each other that look at the wall, about 2.5° apart."""
    cameras = []
    for x, y in [(0, 0), (1.8, 0), (-1.8, 0), (0, 1.8), (0, -1.8), (3.0, 1.0)]:
        pose = np.eye(4)
        pose[:3, 3] = -x, -y, 0
        cameras.append(CAMERA.with_pose(pose))
    return cameras


def test_triangulation_returns_exact_points_and_refuses_contradictions():
    cameras = around()
    points = np.random.default_rng(0).normal(0, 4, (50, 3)) + [0, 0, 40]
    local = np.stack([points @ c.world_to_camera[:3, :3].T + c.world_to_camera[:3, 3] for c in cameras], 1)
    pixels = local[..., :2] / local[..., 2:] * 110 + CAMERA.K[:2, 2]
    pixels[:10, 3:] = np.nan
    found, reliable = triangulate(pixels, cameras)
    assert reliable.all()
    np.testing.assert_allclose(found, points, atol=1e-6)
    pixels[20:, 1] += 5.0
    pixels[10:20, 2:] = np.nan  # matched in one other view only
    _, reliable = triangulate(pixels, cameras)
    assert reliable[:10].all() and not reliable[10:].any()


def test_triangulated_points_lie_on_surface_and_reproject():
    frames = [seen(textured_wall(), seq, camera) for seq, camera in enumerate(around()[:4])]
    found = triangulated(frames[0], frames[1:])
    assert found is not None and len(found.pixels) > 20
    x, y, z = found.points.T
    assert float((z - 40 - 1.5 * torch.sin(x / 5) * torch.cos(y / 6)).abs().median()) < 0.5
    placed = torch.stack([x, y], 1) / z[:, None] * 110 + torch.tensor(CAMERA.K[:2, 2], dtype=torch.float32)
    torch.testing.assert_close(placed, found.pixels, rtol=0, atol=1.0)
    assert (found.pixels % 1 == 0.5).all() and (found.pixels < torch.tensor([96, 80])).all()


def test_triangulation_loss_gradient_moves_surface_back():
    wall = textured_wall()
    frames = [seen(wall, seq, camera) for seq, camera in enumerate(around())]
    loss = TriangulationLoss()
    context = LossContext(frames, lambda _: wall)
    exact = float(loss(wall, frames[0], context))
    means = (1.05 * wall.means).requires_grad_()
    scaled = dataclasses.replace(wall, means=means, log_scales=wall.log_scales + np.log(1.05))
    wrong = loss(scaled, frames[0], context)
    wrong.backward()
    assert wrong.item() > 0.1 and exact < 0.5 * wrong.item()
    seen_splats = means.grad.norm(dim=1) > 0
    outwards = (means.grad * wall.means / wall.means.norm(dim=1, keepdim=True)).sum(1)[seen_splats]
    assert float((outwards > 0).float().mean()) > 0.9


def test_triangulation_loss_refuses_fixed_camera():
    wall = textured_wall(2.0)
    frames = [seen(wall, seq) for seq in range(3)]
    with pytest.raises(InvalidSetting, match="several places, but the camera does not move"):
        TriangulationLoss()(wall, frames[0], LossContext(frames, lambda _: wall))
    assert TriangulationLoss()(wall, frames[0], LossContext(frames[:2], lambda _: wall)) is None


def test_flow_and_triangulation_losses_are_registered():
    config = ReconstructorConfig(losses=("flow:0.1", "triangulation"))
    assert config.losses == ("flow:0.1", "triangulation")
