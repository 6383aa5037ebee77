"""Cost and normal equations of a bundle against plain torch, for adversarial scenes."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.bundle_adjustment import Sights, bundle_cost, bundle_equations, place_camera
from gsplat_core.poses.bundle import descend
from gsplat_core.poses.se3 import exp
from gsplat_core.reference import bundle as reference


def scene(cameras: int, points: int, seen: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, Sights]:
    """Random cameras and points with `seen` observations of random pairs, of which some repeat."""
    random = torch.Generator().manual_seed(seed)
    draw = lambda *size: torch.randn(*size, generator=random, dtype=torch.float64)
    poses, where = exp(0.1 * draw(cameras, 6)), draw(points, 3) + torch.tensor([0.0, 0.0, 6.0])
    camera = torch.randint(0, max(cameras, 1), (seen,), generator=random, dtype=torch.int32)
    point = torch.randint(0, max(points, 1), (seen,), generator=random, dtype=torch.int32)
    local = (poses[camera.long(), :3, :3] @ where[point.long()][:, :, None])[:, :, 0] + poses[camera.long(), :3, 3]
    return poses, where, Sights(camera, point, local[:, :2] / local[:, 2:] + 0.01 * draw(seen, 2), 300.0)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 6), st.integers(1, 9), st.integers(1, 60), st.sampled_from([0.0, 0.7]), st.sampled_from([1e-6, 3.0])
)
def test_bundle_cost_and_equations_equal_reference(cameras, points, seen, flat_px, damping):
    poses, where, sights = scene(cameras, points, seen, seed=seen)
    options = {"spread_px": 1.5, "flat_px": flat_px}
    wanted = reference.bundle_cost(poses, where, sights, **options)
    assert bundle_cost(poses, where, sights, **options) == pytest.approx(wanted, rel=1e-12)
    found = bundle_equations(poses, where, sights, damping=damping, **options)
    expected = reference.bundle_equations(poses, where, sights, damping=damping, **options)
    # Points with one or no observation have equations that only the damping determines.
    many = torch.bincount(sights.point, minlength=points) > 1
    torch.testing.assert_close(found.h, expected.h, rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(found.coupling, expected.coupling, rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(found.inverse[many], expected.inverse[many], rtol=1e-4, atol=1e-9)
    H, g = reference.camera_equations(poses, where, sights, spread_px=1.5, damping=damping)
    if bool(many.all()):
        # S and `right` are small differences of large numbers.
        torch.testing.assert_close(found.S, expected.S, rtol=0, atol=1e-8 * float(H.abs().max()))
        torch.testing.assert_close(found.right, expected.right, rtol=0, atol=1e-8 * float(g.abs().max()))


def test_bundle_equations_are_half_gradient_of_cost():
    """With Cauchy's weights, g and h are half of spread² times the derivatives of the cost."""
    poses, where, sights = scene(3, 8, 50)
    twist = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    moved = where.clone().requires_grad_()
    residual = reference.residuals(exp(twist) @ poses, moved, sights)[0]
    spread = 2.0
    torch.log1p((residual / spread).square().sum(1)).sum().backward()
    found = bundle_equations(poses, where, sights, spread_px=spread, damping=1e9)
    # With that damping the elimination of the points changes nothing.
    torch.testing.assert_close(found.right, spread**2 / 2 * twist.grad, rtol=1e-6, atol=1e-5)
    torch.testing.assert_close(found.h, spread**2 / 2 * moved.grad, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("count", [3, 4, 40])
@pytest.mark.parametrize("size", [1e-6, 0.02, 0.5])
def test_place_camera_equals_reference(count, size):
    poses, where, _ = scene(1, count, 0, seed=count)
    local = where @ poses[0, :3, :3].T + poses[0, :3, 3]
    rays = local[:, :2] / local[:, 2:]
    rays[0] += 0.05
    sights = Sights(torch.zeros(count, dtype=torch.int32), torch.arange(count, dtype=torch.int32), rays, 300.0)
    random = torch.Generator().manual_seed(1)
    start = exp(size * torch.randn(1, 6, generator=random, dtype=torch.float64)) @ poses

    def step(pose, damping):
        H, g = reference.camera_equations(pose, where, sights, spread_px=2.0, damping=damping)
        return exp(-torch.linalg.solve(H, g[:, :, None])[:, :, 0]) @ pose

    def cost_of(pose):
        return reference.bundle_cost(pose, where, sights, spread_px=2.0)

    for rounds in (1, 2, 15):
        wanted, cost = descend(start, step, cost_of, rounds)
        found = place_camera(start[0], where, rays, 300.0, spread_px=2.0, rounds=rounds)
        torch.testing.assert_close(found, wanted[0], rtol=0, atol=1e-7)
        assert cost_of(found[None]) == pytest.approx(cost, rel=1e-7)
    assert cost < cost_of(start)


def test_place_camera_without_points_keeps_pose():
    poses, where, sights = scene(1, 0, 0)
    assert torch.equal(place_camera(poses[0], where, sights.rays, 300.0, spread_px=1.0, rounds=5), poses[0])
    with pytest.raises(InvalidInput, match=r"rays must be \[N, 2\]"):
        place_camera(poses[0], where, torch.ones(2, 2, dtype=torch.float64), 300.0, spread_px=1.0, rounds=5)


def test_bundle_moves_points_behind_camera_to_nearest_depth():
    poses, where, sights = scene(2, 30, 80)
    where[:4, 2] = torch.tensor([-3.0, 0.0, 1e-9, -1e-9])
    found = bundle_equations(poses, where, sights, spread_px=1.0, damping=1.0)
    expected = reference.bundle_equations(poses, where, sights, spread_px=1.0, damping=1.0)
    assert bool(found.S.isfinite().all())
    torch.testing.assert_close(found.coupling, expected.coupling, rtol=1e-9, atol=1e-9)
    cost = reference.bundle_cost(poses, where, sights, spread_px=1.0)
    assert bundle_cost(poses, where, sights, spread_px=1.0) == pytest.approx(cost, rel=1e-12)


def test_bundle_equations_without_observations_contain_damping_only():
    poses, where, sights = scene(2, 3, 0)
    found = bundle_equations(poses, where, sights, spread_px=1.0, damping=2.0)
    torch.testing.assert_close(found.S.view(12, 12), 2e-9 * torch.eye(12, dtype=torch.float64))
    assert not found.right.any() and found.coupling.shape == (0, 6, 3)
    assert bundle_cost(poses, where, sights, spread_px=1.0) == 0


def test_bundle_non_finite_values_propagate():
    poses, where, sights = scene(2, 5, 30)
    where[int(sights.point[0])] = float("nan")
    assert not bool(bundle_equations(poses, where, sights, spread_px=1.0, damping=1.0).S.isfinite().all())
    assert bundle_cost(poses, where, sights, spread_px=1.0) != bundle_cost(poses, where, sights, spread_px=1.0)


def test_bundle_ops_pass_opcheck():
    poses, where, sights = scene(3, 5, 20)
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.bundle_cost.default, (poses, where, *sights, 1.0, 0.5))
    torch.library.opcheck(ops.bundle_equations.default, (poses, where, *sights, 1.0, 0.5, 1e-3))
    torch.library.opcheck(ops.place_camera.default, (poses[0], where, sights.rays[:5], 300.0, 1.0, 3))


def test_bundle_ops_reject_invalid_arguments():
    poses, where, sights = scene(2, 3, 6)
    for arguments, message in [
        ((poses[:, :3], where, sights), r"poses must be \[C, 4, 4\]"),
        ((poses, where[:, :2], sights), r"points must be \[P, 3\]"),
        ((poses.float(), where, sights), "poses must be float64 on the CPU"),
        ((poses, where, sights._replace(camera=sights.camera.long())), "camera must be int32"),
        ((poses, where, sights._replace(point=sights.point[:2])), r"point must be \[M\]"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            bundle_cost(*arguments, spread_px=1.0)
    with pytest.raises(RuntimeError, match=r"camera must be in \[0, 2\), found 2"):
        bundle_cost(poses, where, sights._replace(camera=torch.full_like(sights.camera, 2)), spread_px=1.0)
    with pytest.raises(RuntimeError, match="spread_px must be positive, got 0"):
        bundle_equations(poses, where, sights, spread_px=0.0, damping=1.0)
