"""Focal length is estimated if the scope turns around a scene with relief, and unknown if it only slides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.geometry.tracks import Observations
from gsplat_core.poses import focal_length
from gsplat_core.poses.bundle import Bundle, errors_px
from gsplat_core.poses.focal_length import (
    LEAST_POINTS,
    LONGEST,
    SHORTEST,
    FocalLength,
    focal_length_of,
    trajectory_without_calibration,
    with_focal_length,
)
from gsplat_core.poses.odometry import Trajectory
from gsplat_core.poses.se3 import exp
from gsplat_core.scene.cameras import Camera

WIDTH, HEIGHT, COUNT, POINTS = 320, 256, 12, 70
NOISE_PX = 0.2


def orbit(share: float) -> np.ndarray:
    """Round a scene 60 away, by 30° to each side, up and down."""
    turn = np.array([0.25 * np.sin(3 * share), 0.5 * np.sin(2 * np.pi * share), 0.0])
    pose = exp(torch.tensor([0, 0, 0, *turn], dtype=torch.float64)).numpy()
    pose[:3, 3] = [0, 0, 60] - pose[:3, :3] @ [0, 0, 60]
    return pose


def sideways(share: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, 3] = 8 * np.sin(2 * np.pi * share), 4 * share
    return pose


def seen(way, focal_px: float, points: int = POINTS) -> tuple[Observations, Trajectory]:
    """Return noisy observations of random points in a box by a camera, and its true poses."""
    random = np.random.default_rng(0)
    scene = random.uniform([-22, -18, 48], [22, 18, 72], (points, 3))
    poses = np.stack([way(number / COUNT) for number in range(COUNT)])
    frames, numbers, pixels = [], [], []
    for frame, pose in enumerate(poses):
        local = scene @ pose[:3, :3].T + pose[:3, 3]
        at = focal_px * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2] + random.normal(0, NOISE_PX, (points, 2))
        inside = np.flatnonzero(((at > 0) & (at < [WIDTH, HEIGHT])).all(1))
        frames.append(np.full(len(inside), frame))
        numbers.append(inside)
        pixels.append(at[inside])
    observations = Observations(np.concatenate(frames), np.concatenate(numbers), np.concatenate(pixels))
    return observations, Trajectory(poses, scene, 0.2, 5.0, ())


@pytest.fixture
def search(monkeypatch):
    """Searches for the focal length of what a camera saw, by one that is assumed."""

    def found(way, true_px: float, assumed_px: float, points: int = POINTS) -> FocalLength | None:
        observations, trajectory = seen(way, true_px, points)

        class Tracks:
            def observations(self, least: int) -> Observations:
                return observations

        monkeypatch.setattr(focal_length, "FeatureTracks", Tracks)
        return focal_length_of([], Camera.from_focal(assumed_px, WIDTH, HEIGHT), trajectory)

    return found


@pytest.mark.slow
@pytest.mark.parametrize("true_px", [250.0, 400.0])
def test_focal_length_is_known_for_orbiting_scope(search, true_px):
    found = search(orbit, true_px, assumed_px=288.0)
    assert found is not None and found.known is True and found.assumed_px == 288
    assert found.best_px == pytest.approx(true_px, rel=0.05)
    low_px, high_px = found.range_px
    assert low_px < true_px < high_px and high_px / low_px < 1.3


def test_focal_length_is_unknown_for_sliding_scope(search):
    found = search(sideways, 288.0, assumed_px=288.0)
    assert found is not None and found.known is False
    assert found.range_px == pytest.approx((SHORTEST * WIDTH, LONGEST * WIDTH))


@pytest.mark.slow
def test_focal_length_beyond_bounds_is_unknown(search):
    found = search(orbit, 700.0, assumed_px=288.0, points=120)
    assert found is not None and not found.known and found.range_px[1] == pytest.approx(LONGEST * WIDTH)


def test_focal_length_search_is_none_for_few_points(search):
    assert search(orbit, 288.0, 288.0, points=LEAST_POINTS - 1) is None


@pytest.mark.slow
def test_focal_length_search_is_deterministic(search):
    assert search(sideways, 330.0, 288.0) == search(sideways, 330.0, 288.0)


@pytest.mark.parametrize("known", [True, False])
def test_trajectory_is_estimated_again_only_for_known_focal_length(monkeypatch, known):
    asked = []

    def trajectory_of(frames, camera):
        asked.append((list(frames), float(camera.K[0, 0])))
        return seen(orbit, 330.0)[1]

    answer = FocalLength(288.0, 330.0, (300.0, 360.0), known)
    monkeypatch.setattr(focal_length, "trajectory_of", trajectory_of)
    monkeypatch.setattr(focal_length, "focal_length_of", lambda frames, camera, found: answer)
    _, said = trajectory_without_calibration(lambda: iter("abc"), Camera.from_focal(288.0, WIDTH, HEIGHT))
    assert said is answer
    assert asked == [(["a", "b", "c"], 288.0), *([(["a", "b", "c"], 330.0)] if known else [])]


def test_with_focal_length_keeps_principal_point_and_pose():
    camera = Camera.from_focal(288.0, WIDTH, HEIGHT, orbit(0.3))
    other = with_focal_length(camera, 300.0)
    assert (other.K[0, 0], other.K[1, 1]) == (300, 300) and np.array_equal(other.K[:, 2], camera.K[:, 2])
    assert np.array_equal(other.world_to_camera, camera.world_to_camera) and camera.K[0, 0] == 288


def test_refine_starts_from_nearest_tried_focal_lengths():
    """Expected value: the minimum of a parabola in log focal length, between candidates a factor of 1.5 apart."""
    starts = []

    def tried(focal_px, near):
        starts.append((focal_px, near.bundle))
        return focal_length._Try(focal_px, np.log(focal_px / 330.0) ** 2)

    tries = {
        focal_px: focal_length._Try(focal_px, np.log(focal_px / 330.0) ** 2) for focal_px in (160.0, 240, 360, 540)
    }
    known = set(tries)
    focal_length._refine(tries, tried)
    best_px = min(tries, key=lambda focal_px: tries[focal_px].cost)
    assert best_px == pytest.approx(330, rel=0.02) and len(starts) > 0
    for focal_px, start_px in starts:
        assert max(focal_px / start_px, start_px / focal_px) == min(
            max(focal_px / each, each / focal_px) for each in known
        )
        known.add(focal_px)


def test_without_outliers_removes_point_close_to_lens():
    """All rays are exact. The scope was withdrawn by 40, so that the scene is 60 away and one point is 1 away."""
    points = torch.tensor([[1.0, 2, 20], [-3, 1, 21], [2, -2, 19], [0.01, 0.01, -39]], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 2, 3] = 40
    poses[:, 0, 3] = torch.tensor([-0.1, 0, 0.1])
    camera, point = torch.arange(3).repeat_interleave(4), torch.arange(4).repeat(3)
    local = points[point] + poses[camera, :3, 3]
    bundle = Bundle(poses, points, camera, point, local[:, :2] / local[:, 2:], 288.0)
    kept = focal_length._without_outliers(bundle, 3.0)
    assert torch.equal(kept.points, points[:3])
    assert kept.point.tolist() == [0, 1, 2] * 3 and kept.camera.tolist() == [0] * 3 + [1] * 3 + [2] * 3


def searched(monkeypatch, error_px, assumed_px: float) -> tuple[FocalLength, list[tuple[float, float]]]:
    """Return the focal length found where the errors depend on it alone, and the tried ones with those they start from."""
    tries = []

    def with_focal(bundle, focal_px):
        tries.append((focal_px, bundle.focal_px))
        return replace(bundle, focal_px=focal_px)

    monkeypatch.setattr(focal_length, "_with_focal", with_focal)
    monkeypatch.setattr(focal_length, "_adjusted", lambda bundle, spread_px: bundle)
    monkeypatch.setattr(
        focal_length, "errors_px", lambda bundle: torch.full((100,), error_px(bundle.focal_px)).double()
    )
    start = Bundle(*(torch.zeros(0),) * 5, assumed_px)
    return focal_length._search(start, 200.0), tries


def bowl(steep: float):
    """Return errors in pixels: half a pixel at 170, and more by the square of the logarithm of the ratio."""
    return lambda focal_px: 0.5 + steep * np.log(focal_px / 170.0) ** 2


def test_focal_length_search_proceeds_outwards_from_assumed(monkeypatch):
    found, tries = searched(monkeypatch, bowl(3.0), assumed_px=210.0)
    first = tries[:8]
    asked = sorted(focal_px for focal_px, _ in first)
    np.testing.assert_allclose(np.diff(np.log(asked)), np.log(1.6 / 0.6) / 7)
    assert asked[0] == pytest.approx(120) and asked[-1] == pytest.approx(320)
    longer, shorter = [each for each in asked if each >= 210], [each for each in asked if each < 210][::-1]
    expected = [*zip(longer, [210.0, *longer], strict=False), *zip(shorter, [210.0, *shorter], strict=False)]
    assert first == expected
    assert len(tries) == 12 and found.assumed_px == 210
    assert found.best_px == pytest.approx(170, rel=0.03)


@pytest.mark.parametrize(
    ("steep", "known", "ends"), [(3.0, True, (1.0, 1.5)), (0.11, True, (1.2, 1.5)), (0.05, False, (1.5, 2.6))]
)
def test_focal_length_is_known_if_plausible_range_is_below_factor_1_5(monkeypatch, steep, known, ends):
    """The robust cost at the ends of the range is one per cent above the least."""
    found, _ = searched(monkeypatch, bowl(steep), assumed_px=200.0)
    low, high = found.range_px
    assert found.known == known and ends[0] < high / low < ends[1] and low < 170 < high


def test_plausible_focal_range_ends_at_one_percent_higher_cost():
    tries = {
        focal_px: focal_length._Try(None, cost) for focal_px, cost in ((50.0, 1.0), (100.0, 4.0), (200.0, 2.0), (400.0, 2.01), (800.0, 2.03))
    }  # fmt: skip
    low, high = focal_length._range(tries, 200.0)
    assert low == pytest.approx(200 * 0.5**0.01) and high == pytest.approx(400 * 2**0.5)
    assert focal_length._range({100.0: tries[200.0], 150.0: tries[200.0]}, 100.0) == (100.0, 150.0)


def test_with_focal_keeps_pixels_of_flat_scene():
    random = np.random.default_rng(1)
    points = torch.from_numpy(np.concatenate([random.uniform(-10, 10, (40, 2)), np.full((40, 1), 60.0)], 1))
    poses = exp(torch.tensor([[0.0] * 6, [2, -1, 3, 0, 0, 0.2], [-3, 2, -4, 0, 0, -0.4]], dtype=torch.float64))
    camera, point = torch.arange(3).repeat_interleave(40), torch.arange(40).repeat(3)
    local = (poses[camera, :3, :3] @ points[point][:, :, None])[:, :, 0] + poses[camera, :3, 3]
    bundle = Bundle(poses, points, camera, point, local[:, :2] / local[:, 2:], 300.0)
    for focal_px in (200.0, 450.0):
        other = focal_length._with_focal(bundle, focal_px)
        assert float(errors_px(other).max()) < 1e-9
        torch.testing.assert_close(other.rays * focal_px, bundle.rays * 300)
        torch.testing.assert_close(other.points[:, 2], points[:, 2])
    # A turn about a horizontal axis is about a shift of the picture, which is larger for a longer lens.
    turned = replace(bundle, poses=exp(torch.tensor([[0.0, 0, 0, 0.02, -0.01, 0]] * 3, dtype=torch.float64)))
    local = (turned.poses[camera, :3, :3] @ points[point][:, :, None])[:, :, 0]
    turned = replace(turned, rays=local[:, :2] / local[:, 2:])
    assert float(errors_px(focal_length._with_focal(turned, 450.0)).max()) < 0.3


def test_triangulated_points_equal_true_points():
    observations, trajectory = seen(orbit, 288.0)
    poses, points = torch.from_numpy(trajectory.poses), torch.from_numpy(trajectory.points)
    frame, number = torch.from_numpy(observations.frame), torch.from_numpy(observations.point)
    local = (poses[frame, :3, :3] @ points[number][:, :, None])[:, :, 0] + poses[frame, :3, 3]
    found = focal_length._triangulated(poses, frame, number, local[:, :2] / local[:, 2:], POINTS)
    torch.testing.assert_close(found, points, atol=1e-4, rtol=0)


def test_focal_start_excludes_outliers_and_points_seen_twice():
    """Four of 70 points are seen in two frames only. Five others are seen in three, with one observation off by 5 pixels."""
    observations, trajectory = seen(orbit, 288.0)
    kept, rank = np.ones(len(observations.frame), bool), np.zeros(POINTS, int)
    for place, number in enumerate(observations.point):
        rank[number] += 1
        kept[place] = rank[number] <= (2 if number < 4 else 3 if number < 9 else 99)
    some = observations.of(kept)
    for number in range(4, 9):
        some.pixels[np.flatnonzero(some.point == number)[1]] += [3.0, -4.0]
    far = np.flatnonzero((some.point == 30) & (some.frame == 5))
    some.pixels[far] += [0.0, 5.0]
    start = focal_length._start(some, Camera.from_focal(288.0, WIDTH, HEIGHT), trajectory)
    assert start is not None and len(start.points) == POINTS - 9
    assert int((start.point == 30 - 9).sum()) == (some.point == 30).sum() - 1
    assert float(errors_px(start).max()) < 3 and float(errors_px(start).median()) < 2 * NOISE_PX


def test_focal_start_uses_twenty_key_frames():
    observations, trajectory = seen(lambda share: orbit(share / 5), 288.0)
    pieces = []
    for repeat in range(5):
        frame = observations.frame * 5 + repeat
        pieces.append(Observations(frame, observations.point, observations.pixels))
    order = np.argsort(np.concatenate([each.frame for each in pieces]), kind="stable")
    whole = Observations(*(np.concatenate([getattr(each, name) for each in pieces])[order] for name in ("frame", "point", "pixels")))  # fmt: skip
    poses = trajectory.poses.repeat(5, 0)
    start = focal_length._start(whole, Camera.from_focal(288.0, WIDTH, HEIGHT), replace(trajectory, poses=poses))
    assert start is not None and len(start.poses) == 20
    torch.testing.assert_close(start.poses[0], torch.from_numpy(poses[0]))


@pytest.mark.parametrize(("points", "enough"), [(49, False), (50, True)])
def test_focal_start_requires_fifty_points(points, enough):
    observations, trajectory = seen(lambda share: orbit(share / 3), 250.0, points)
    assert (
        focal_length._start(observations, Camera.from_focal(250.0, WIDTH, HEIGHT), trajectory) is not None
    ) == enough
