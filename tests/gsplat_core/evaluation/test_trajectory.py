"""The trajectory error of known trajectories."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.geometry import evaluate_trajectory
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene


def _way(count: int = 40) -> np.ndarray:
    scene = SyntheticScene.from_seed(0, 48, 40, 4.0, True)
    return np.stack([scene.camera_at(k / 10).world_to_camera for k in range(count)])


def _elsewhere(poses: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Return a trajectory in another world frame: rotated, shifted and scaled."""
    angle = 0.8
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    moved = poses.copy()
    moved[:, :3, :3] = poses[:, :3, :3] @ turn.T
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    there = scale * centres @ turn.T + [3.0, -20.0, 7.0]
    moved[:, :3, 3] = -np.einsum("nij,nj->ni", moved[:, :3, :3], there)
    return moved


def test_trajectory_error_zero_in_different_world_frame() -> None:
    way = _way()
    errors = evaluate_trajectory(_elsewhere(way), way)
    assert errors is not None and errors.frames == 40
    assert errors.rigid_share < 1e-9 and errors.rotation_deg < 1e-5 and errors.scale == pytest.approx(1)
    assert errors.path == pytest.approx(np.linalg.norm(np.diff(np.linalg.inv(way)[:, :3, 3], axis=0), axis=1).sum())
    assert 0.02 < errors.still_share < 1


def test_trajectory_without_scale_correct_after_one_factor() -> None:
    way = _way()
    errors = evaluate_trajectory(_elsewhere(way, 0.25), way)
    assert errors is not None and errors.scale == pytest.approx(4)
    assert errors.similarity_share < 1e-9
    # What is left of a way that is a quarter as long is three quarters of no motion at all.
    assert errors.rigid_share == pytest.approx(0.75 * errors.still_share)


def test_trajectory_error_equals_added_noise() -> None:
    way = _way()
    off = way.copy()
    jitter = 0.3 * np.random.default_rng(0).standard_normal((len(way), 3))
    off[:, :3, 3] += jitter
    errors = evaluate_trajectory(off, way)
    assert errors is not None
    assert errors.rigid_rmse == pytest.approx(0.3 * np.sqrt(3), rel=0.2)
    assert errors.rigid_share == pytest.approx(errors.rigid_rmse / errors.path)


def test_trajectory_of_scope_at_rest_is_none_and_static_estimate_is_baseline() -> None:
    way, still = _way(), np.tile(np.eye(4), (40, 1, 1))
    assert evaluate_trajectory(way, still) is None
    errors = evaluate_trajectory(still, way)
    assert errors is not None
    assert errors.rigid_share == errors.similarity_share == errors.still_share > 0 and errors.scale == 0


@pytest.mark.slow
def test_trajectory_rejects_too_few_poses() -> None:
    with pytest.raises(InvalidInput, match=r"\[2, 4, 4\]"):
        evaluate_trajectory(_way(2), _way(2))
    with pytest.raises(InvalidInput, match="three or more"):
        evaluate_trajectory(_way(4), _way(5))
