"""Rendered flow and occlusion: rigid and affine motion, which have exact flow, hidden surfaces, and gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from gsplat_core import Camera, Gaussians, InvalidInput
from gsplat_core.errors import InvalidSetting
from gsplat_core.rendering.flow import (
    NEIGHBOURS,
    RenderedFlow,
    deformation_gradients,
    nearest_splats,
    occluded,
    render_depth,
    render_flow,
    rotations,
)
from tests.gsplat_core.rendering.test_surface import wall

CAMERA = Camera.from_focal(50.0, 45, 37)


def turn(angle_deg: float, axis: tuple[float, float, float]) -> Tensor:
    """Return the quaternion [1, 4] of a rotation."""
    half = math.radians(angle_deg) / 2
    direction = torch.tensor(axis, dtype=torch.float64)
    return torch.cat([torch.tensor([math.cos(half)]).double(), math.sin(half) * direction / direction.norm()])[None]


def product(p: Tensor, q: Tensor) -> Tensor:
    """Return the Hamilton product of quaternions [..., 4]."""
    w, v = p[..., :1], p[..., 1:]
    x, u = q[..., :1], q[..., 1:]
    return torch.cat([w * x - (v * u).sum(-1, keepdim=True), w * u + x * v + torch.linalg.cross(v, u)], -1)


def moved_by(
    gaussians: Gaussians, matrix: Tensor, shift: Tensor, centre: Tensor, quat: Tensor | None = None
) -> Gaussians:
    """Move Gaussians by X -> centre + matrix (X - centre) + shift, and turn them by `quat`."""
    means = centre + (gaussians.means.double() - centre) @ matrix.T + shift
    quats = (
        gaussians.quats.double() if quat is None else product(quat.expand(gaussians.count, 4), gaussians.quats.double())
    )
    return Gaussians(
        means.to(gaussians.dtype),
        quats.to(gaussians.dtype),
        gaussians.log_scales,
        gaussians.logit_opacities,
        gaussians.sh,
    )


def exact_flow(depth: Tensor, camera: Camera, matrix: Tensor, shift: Tensor, centre: Tensor, to: Camera) -> Tensor:
    """Return the flow [H, W, 2] of a surface of known depth [H, W] that moves affinely."""
    K = torch.tensor(camera.K)
    y, x = torch.meshgrid(torch.arange(camera.height_px) + 0.5, torch.arange(camera.width_px) + 0.5, indexing="ij")
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1).double()
    points = rays * depth.double()[..., None]
    there = centre + (points - centre) @ matrix.T + shift
    pose = torch.tensor(to.world_to_camera)
    there = there @ pose[:3, :3].T + pose[:3, 3]
    pixels = there[..., :2] / there[..., 2:] * torch.tensor(to.K)[[0, 1], [0, 1]] + torch.tensor(to.K)[:2, 2]
    return pixels - torch.stack([x, y], -1)


CENTRE = torch.tensor([0.0, 0.0, 40.0], dtype=torch.float64)


def wall_depth(tilt_deg: float, camera: Camera = CAMERA) -> Tensor:
    ray_x = (torch.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    return (40.0 / (1 - math.tan(math.radians(tilt_deg)) * ray_x)).expand(camera.height_px, -1)


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (0.3, 1, -0.5)])
def test_flow_of_rigid_motion_is_exact(tilt_deg, axis, device):
    gaussians = wall(tilt_deg, thickness=0.002)
    quat = turn(10.0, axis)
    matrix, shift = rotations(quat)[0], torch.tensor([1.0, -0.5, 2.0]).double()
    second = moved_by(gaussians, matrix, shift, CENTRE, quat)
    pose = np.eye(4)
    pose[:3, 3] = 0.4, -0.3, 0.6
    to = Camera(CAMERA.K * np.array([[1.02], [1.02], [1.0]]), 45, 37, pose)
    found = render_flow(gaussians.to(device), second.to(device), CAMERA, to)
    wanted = exact_flow(wall_depth(tilt_deg), CAMERA, matrix, shift, CENTRE, to)
    assert bool(found.observed.all())
    assert float((found.flow.cpu() - wanted).abs().max()) < 1e-3


def test_flow_follows_affine_motion_better_than_gaussianflow():
    gaussians = wall(20.0, thickness=0.002)
    stretch = torch.tensor([[1.05, 0.03, 0.0], [0.0, 0.97, 0.02], [0.01, 0.0, 1.04]]).double()
    spin = rotations(turn(10.0, (0, 0, 1)))[0]
    matrix, shift = spin @ stretch, torch.tensor([0.5, 0.2, -0.4]).double()
    second = moved_by(gaussians, matrix, shift, CENTRE, turn(10.0, (0, 0, 1)))
    wanted = exact_flow(wall_depth(20.0), CAMERA, matrix, shift, CENTRE, CAMERA)
    off = lambda mode: (render_flow(gaussians, second, CAMERA, CAMERA, mode=mode).flow - wanted).norm(dim=-1)
    assert float(off("neighbours").quantile(0.95)) < 0.03
    assert float(off("gaussianflow").median()) > 0.03


def test_gaussianflow_follows_translation():
    gaussians = wall(0.0, thickness=0.002)
    shift = torch.tensor([2.0, -1.0, 0.0]).double()
    second = moved_by(gaussians, torch.eye(3).double(), shift, CENTRE)
    found = render_flow(gaussians, second, CAMERA, CAMERA, mode="gaussianflow").flow
    torch.testing.assert_close(found, torch.tensor([2.5, -1.25]).expand(found.shape), atol=5e-3, rtol=0)


def test_render_depth_equals_wall_depth(device):
    depth = render_depth(wall(35.0, thickness=0.002).to(device), CAMERA).cpu()
    assert float((depth / wall_depth(35.0) - 1).abs().max()) < 1e-3


def test_occluded_marks_hidden_and_outside_surfaces():
    far = wall(0.0, 44.0)
    near = wall(0.0, 40.0)
    tool = near.select((near.means[:, 0].abs() < 6) & (near.means[:, 1].abs() < 6))
    moves = lambda scene, x: Gaussians(
        scene.means + torch.tensor([x, 0.0, 0.0]), scene.quats, scene.log_scales, scene.logit_opacities, scene.sh
    )
    # Separate searches: a neighbourhood does not reach across the gap.
    first, second = far.append(tool), far.append(moves(tool, 10.0))
    forward = render_flow(first, second, CAMERA, CAMERA)
    backward = render_flow(second, first, CAMERA, CAMERA)
    hidden = occluded(forward, backward, render_depth(second, CAMERA))
    # The tool covers columns 15 to 30, and then 27.5 to 42.5 of the wall.
    assert bool(hidden[18, 33:40].all()) and not bool(hidden[18, 1:13].any()) and not bool(hidden[3].any())
    assert not bool(hidden[18, 18:26].any())
    away = render_flow(far, moves(far, 44.0), CAMERA, CAMERA)
    outside = occluded(away, RenderedFlow(-away.flow, away.depth, away.alpha), torch.zeros(37, 45))
    assert bool(outside.all())


def test_flow_gradients_reach_second_state_only():
    first = wall(15.0)
    first.requires_grad_()
    second = moved_by(first.detach(), torch.eye(3).double(), torch.tensor([0.3, 0.1, 0.2]).double(), CENTRE)
    second.requires_grad_()
    found = render_flow(first, second, CAMERA, CAMERA)
    (found.flow.square().mean() + 0.01 * found.depth.mean()).backward()
    assert bool((second.means.grad != 0).any()) and bool((second.quats.grad != 0).any())
    assert all(tensor.grad is None for tensor in first.tensors().values())
    # Descent along the gradient reduces the flow.
    with torch.no_grad():
        less = Gaussians(
            second.means - 10 * second.means.grad, second.quats, second.log_scales, second.logit_opacities, second.sh
        )
        assert float(render_flow(first, less, CAMERA, CAMERA).flow.square().mean()) < float(found.flow.square().mean())


@pytest.mark.slow
def test_deformation_gradients_pass_gradcheck():
    first = wall(15.0).select(slice(0, 30)).to(dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    near = nearest_splats(first)
    assert near.shape == (30, NEIGHBOURS)
    means = first.means + 0.2 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    quats = first.quats + 0.1 * torch.randn(30, 4, generator=generator, dtype=torch.float64)

    def evaluate(means: Tensor, quats: Tensor) -> Tensor:
        second = Gaussians(means, quats, first.log_scales, first.logit_opacities, first.sh)
        return deformation_gradients(first, second, near)

    assert torch.autograd.gradcheck(evaluate, (means.requires_grad_(), quats.requires_grad_()), fast_mode=True)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_flow_of_few_splats_uses_own_rotation(count):
    few = wall(0.0).select(slice(2500, 2500 + count))
    quat = turn(20.0, (0, 0, 1))
    second = moved_by(few, rotations(quat)[0], torch.zeros(3).double(), CENTRE, quat)
    found = render_flow(few, second, CAMERA, CAMERA)
    assert bool(torch.isfinite(found.flow).all()) and found.flow.shape == (37, 45, 2)
    if count:
        gradients = deformation_gradients(few, second, nearest_splats(few))
        torch.testing.assert_close(gradients, rotations(quat).float().expand(count, 3, 3), atol=1e-4, rtol=0)


def test_flow_rejects_invalid_requests():
    one = wall(0.0)
    with pytest.raises(InvalidSetting, match="mode of the flow is 'roots'; choose neighbours or gaussianflow"):
        render_flow(one, one, CAMERA, CAMERA, mode="roots")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="the same Gaussians at both times, got 5 and 4"):
        render_flow(one.select(slice(5)), one.select(slice(4)), CAMERA, CAMERA)
    with pytest.raises(InvalidInput, match="pinhole cameras, got 'ortho'"):
        render_flow(one, one, CAMERA, Camera(CAMERA.K, 45, 37, model="ortho"))
