"""Focal length is estimated if the scope turns around a scene with relief, and unknown if it only slides."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.geometry.tracks import Observations
from gsplat_core.poses import focal_length
from gsplat_core.poses.bundle import Bundle
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
def test_a_scope_that_turns_around_tissue_tells_it(search, true_px):
    found = search(orbit, true_px, assumed_px=288.0)
    assert found is not None and found.known is True and found.assumed_px == 288
    assert found.best_px == pytest.approx(true_px, rel=0.05)
    low_px, high_px = found.range_px
    assert low_px < true_px < high_px and high_px / low_px < 1.3


def test_a_scope_that_slides_along_tells_nothing(search):
    found = search(sideways, 288.0, assumed_px=288.0)
    assert found is not None and found.known is False
    assert found.range_px == pytest.approx((SHORTEST * WIDTH, LONGEST * WIDTH))


@pytest.mark.slow
def test_one_beyond_the_bounds_is_not_known(search):
    found = search(orbit, 700.0, assumed_px=288.0, points=120)
    assert found is not None and not found.known and found.range_px[1] == pytest.approx(LONGEST * WIDTH)


def test_too_few_points_tell_nothing(search):
    assert search(orbit, 288.0, 288.0, points=LEAST_POINTS - 1) is None


@pytest.mark.slow
def test_the_same_points_give_the_same_answer(search):
    assert search(sideways, 330.0, 288.0) == search(sideways, 330.0, 288.0)


@pytest.mark.parametrize("known", [True, False])
def test_poses_are_estimated_again_only_for_a_focal_length_that_is_known(monkeypatch, known):
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


def test_another_focal_length_leaves_the_rest_of_a_camera():
    camera = Camera.from_focal(288.0, WIDTH, HEIGHT, orbit(0.3))
    other = with_focal_length(camera, 300.0)
    assert (other.K[0, 0], other.K[1, 1]) == (300, 300) and np.array_equal(other.K[:, 2], camera.K[:, 2])
    assert np.array_equal(other.world_to_camera, camera.world_to_camera) and camera.K[0, 0] == 288


def test_the_best_candidate_is_refined_from_its_nearest_neighbours():
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


def test_a_point_before_the_lens_is_an_outlier_however_far_the_scope_was_moved():
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
