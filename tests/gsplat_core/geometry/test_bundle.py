"""Bundle adjustment against scenes whose cameras and points are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.poses.bundle import Bundle, adjust, descend, errors_px, moved, place_cameras, placed
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


def test_adjust_recovers_noise_free_scene():
    true = known_scene()
    start = disturbed(true)
    assert float(errors_px(start).median()) > 2
    found = adjust(start, fixed=first_only(true), rounds=60)
    assert float(errors_px(found).max()) < 1e-3
    assert way_off(found, true) < 0.01
    assert torch.equal(found.poses[0], true.poses[0])


def test_adjust_is_robust_to_moving_points():
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


def test_place_cameras_recovers_poses_for_known_points():
    true = known_scene()
    start = replace(disturbed(true), points=true.points)
    found = place_cameras(start, fixed=first_only(true), rounds=20)
    torch.testing.assert_close(found, true.poses, atol=1e-6, rtol=0)
    assert torch.equal(found[0], start.poses[0])


def stepped(start: Bundle, rounds: int, points_move: bool) -> Bundle:
    if points_move:
        return adjust(start, fixed=first_only(start), rounds=rounds)
    return replace(start, poses=place_cameras(start, fixed=first_only(start), rounds=rounds))


@pytest.mark.parametrize("points_move", [True, False])
def test_bundle_step_never_increases_cost(points_move):
    true = known_scene(cameras=4, points=12)
    bundle = disturbed(true, 0.1)
    before = float(torch.log1p(errors_px(bundle).square()).sum())
    for _ in range(5):
        bundle = stepped(bundle, 1, points_move)
        cost = float(torch.log1p(errors_px(bundle).square()).sum())
        assert cost <= before
        before = cost


def test_adjust_tolerates_point_behind_camera():
    true = known_scene(cameras=3, points=30)
    points = true.points.clone()
    points[0, 2] = -5
    found = adjust(replace(true, points=points), fixed=first_only(true))
    assert torch.isfinite(found.points).all() and torch.isfinite(found.poses).all()
    assert float(errors_px(found)[true.point != 0].max()) < 1


def test_adjust_with_non_finite_point_changes_nothing():
    true = known_scene(cameras=3, points=30)
    start = disturbed(true)
    start.points[4, 0] = float("nan")
    found = adjust(start, fixed=first_only(true))
    assert torch.equal(found.poses, start.poses) and torch.equal(found.points[5:], start.points[5:])


@pytest.mark.parametrize("points_move", [True, False])
def test_bundle_steps_converge_quadratically(points_move):
    """With an error in a derivative, steps still improve, but five of them do not reach 1e-7 px from 20 px."""
    true = known_scene()
    start = disturbed(true)
    if not points_move:
        start = replace(start, points=true.points)
    assert float(errors_px(start).max()) > 20
    found = stepped(start, 5, points_move)
    assert float(errors_px(found).max()) < 1e-7


def sliding_scope(seed: int) -> Bundle:
    """Cameras that slide sideways at a distance of 1 in front of a surface with a relief of 5 %, observed to 0.2 px."""
    random = np.random.default_rng(seed)
    cameras, points = 30, 150
    x, y = random.uniform(-0.6, 0.6, points), random.uniform(-0.45, 0.45, points)
    where = np.stack([x, y, 1 + 0.05 * np.sin(5 * x) * np.cos(4 * y)], 1)
    time = np.linspace(0, 1, cameras)
    place = np.stack([0.2 * np.sin(6 * time), 0.15 * np.sin(4 * time), 0 * time], 1)
    local = where - place[:, None]
    rays = local[..., :2] / local[..., 2:] + random.normal(0, 0.2 / FOCAL, (cameras, points, 2))
    poses = np.tile(np.eye(4), (cameras, 1, 1))
    poses[:, :3, 3] = -place
    camera, point = np.divmod(np.arange(cameras * points), points)
    return Bundle(*map(torch.from_numpy, (poses, where, camera, point, rays.reshape(-1, 2))), FOCAL)


def with_rotation(true: Bundle) -> Bundle:
    """Return a start that explains half of the sliding by rotation, and has half of the points 20 times as far away."""
    place = -true.poses[:, :3, 3]
    turn = torch.stack([place[:, 1], -place[:, 0], 0 * place[:, 0]], 1)
    far = torch.ones(len(true.points), 1, dtype=torch.float64)
    far[::2] = 20
    return replace(true, poses=exp(0.5 * torch.cat([-place, turn], 1)), points=far * true.points)


def turned_deg(bundle: Bundle) -> float:
    """Largest angle between a camera and the first one in degrees."""
    turn = bundle.poses[:, :3, :3] @ bundle.poses[0, :3, :3].T
    return float(torch.rad2deg(torch.arccos(((torch.einsum("nii->n", turn) - 1) / 2).clamp(-1, 1))).max())


@pytest.mark.parametrize("seed", [0, 1])
def test_flat_px_prevents_explaining_sliding_by_rotation(seed):
    true = sliding_scope(seed)
    start, fixed = with_rotation(true), first_only(true)
    without = adjust(start, fixed=fixed, rounds=50)
    assert turned_deg(without) > 5 and way_off(without, true) > 0.05
    flat = adjust(start, fixed=fixed, rounds=25, flat_px=33.0)
    assert turned_deg(flat) < 1 and way_off(flat, true) < 0.02
    released = adjust(flat, fixed=fixed, rounds=25)
    assert turned_deg(released) < 0.3 and way_off(released, true) < 0.005


def test_flat_px_adds_squared_relief_to_cost():
    """The minimum of a cost that is written out in numpy, by its differences in all directions of the points."""
    true = sliding_scope(0)
    true = replace(true, poses=true.poses[::6], camera=true.camera // 6)
    few = (torch.arange(30 * 150) // 150) % 6 == 0
    true = replace(true, camera=true.camera[few], point=true.point[few], rays=true.rays[few])
    flat_px, spread_px = 100.0, 2.0
    found = adjust(disturbed(true, 1e-3), fixed=first_only(true), rounds=100, spread_px=spread_px, flat_px=flat_px)

    def cost_of(points: np.ndarray, middle: float) -> float:
        pose = found.poses.numpy()[found.camera]
        local = np.einsum("mij,mj->mi", pose[:, :3, :3], points[found.point]) + pose[:, :3, 3]
        off = FOCAL * (local[:, :2] / local[:, 2:] - found.rays.numpy())
        seen = spread_px**2 * np.log1p((off**2).sum(1) / spread_px**2).sum()
        return float(seen + (flat_px**2 * (points[:, 2] / middle - 1) ** 2).sum())

    points = found.points.numpy()
    middle = float(found.points[:, 2].median())
    share = np.abs(points[:, 2] / middle - 1)
    assert 0.002 < share.max() < 0.04
    random = np.random.default_rng(2)
    for _ in range(20):
        step = 1e-4 * random.normal(size=points.shape)
        ahead, here, behind = (cost_of(points + sign * step, middle) for sign in (1, 0, -1))
        assert abs(ahead - behind) < 0.02 * (ahead + behind - 2 * here)


def test_errors_px_are_distances_in_pixels():
    true = known_scene(cameras=2, points=5)
    rays = true.rays.clone()
    rays[3] += torch.tensor([3.0, -4.0], dtype=torch.float64) / FOCAL
    errors = errors_px(replace(true, rays=rays))
    torch.testing.assert_close(errors, 5.0 * (torch.arange(10) == 3).double(), atol=1e-9, rtol=0)


@pytest.mark.parametrize("size", [0.0, 1e-13, 1e-6, 9e-5, 1.1e-4, 0.01, 0.7, 2.5])
def test_moved_pose_equals_matrix_exponential_of_twist(size):
    twist = np.array([0.3, -0.2, 0.5, *(size * np.array([0.6, -0.64, 0.48]))])
    pose = exp(torch.tensor([1.0, 2.0, -3.0, 0.4, 0.5, -0.6], dtype=torch.float64))
    generator = torch.zeros(4, 4, dtype=torch.float64)
    x, y, z = twist[3:]
    generator[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    generator[:3, 3] = torch.from_numpy(twist[:3])
    wanted = torch.linalg.matrix_exp(generator) @ pose
    np.testing.assert_allclose(moved(pose.numpy(), twist), wanted.numpy(), atol=1e-13, rtol=0)


def one_camera(index: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    true = known_scene()
    return true.poses[index].numpy(), true.points.numpy(), true.rays[true.camera == index].numpy()


@pytest.mark.parametrize("size", [0.01, 0.05])
def test_placed_camera_is_exact_for_exact_rays(size):
    pose, points, rays = one_camera()
    start = moved(pose, size * np.array([1.0, -2.0, 3.0, 1.0, -1.0, 0.5]))
    start[:3, :3] *= 1.001  # a rotation that has accumulated rounding errors
    found, errors = placed(start, points, rays, FOCAL)
    np.testing.assert_allclose(found, pose, atol=1e-10)
    assert errors.max() < 1e-8


def test_placed_camera_is_robust_to_outliers():
    pose, points, rays = one_camera()
    rays[:15] += np.array([30.0, -40.0]) / FOCAL
    found, errors = placed(moved(pose, np.full(6, 0.01)), points, rays, FOCAL)
    assert errors[15:].max() < 0.15 and abs(errors[:15] - 50).max() < 0.15
    assert np.abs(found[:3, 3] - pose[:3, 3]).max() < 0.05


def test_placed_camera_tolerates_points_behind_camera():
    pose, points, rays = one_camera()
    points = points.copy()
    points[:4, 2] -= 200
    found, errors = placed(moved(pose, np.full(6, 0.01)), points, rays, FOCAL)
    assert np.isfinite(errors).all() and errors[4:].max() < 1.5 and np.isfinite(found).all()


def test_descend_adapts_damping_to_success_and_failure():
    """Steps succeed while the state is above 3, as the cost then falls."""
    dampings = []

    def step(state, damping):
        dampings.append(damping)
        return state - 1

    state, cost = descend(6.0, step, lambda state: 1.0 + abs(state - 3.2), rounds=100)
    assert state == 3.0 and cost == pytest.approx(1.2)
    successes = [1e-4 / 5**number for number in range(4)]
    assert dampings[:4] == pytest.approx(successes)
    ratios = np.divide(dampings[4:], dampings[3:-1])
    assert np.allclose(ratios, 8) or np.allclose(ratios[1:], 8)
    assert dampings[-1] * 8 > 1e4 >= dampings[-1]


def test_descend_ends_at_convergence_or_after_rounds():
    calls = []

    def step(state, damping):
        calls.append(damping)
        return state + 1

    descend(0, step, lambda state: 1.0 - 1e-7 * state, rounds=50)
    assert len(calls) == 1
    calls.clear()
    assert descend(0, step, lambda state: 100.0 - state, rounds=20)[0] == 20
    assert len(calls) == 20 and min(calls) == pytest.approx(1e-9)
