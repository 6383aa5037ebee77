"""Tissue that is pulled in a known direction."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.experimental.breathing_depth import Pull, pull_of

FOCAL_PX = 280.0
DIRECTION = np.array([0.38, 0.25, -0.89]) / np.linalg.norm([0.38, 0.25, -0.89])


def pulled(strength: float, seed: int, noise_px: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays where points are seen, how far they are off, and how far they came along the line of sight, relative to their distance."""
    random = np.random.default_rng(seed)
    points = np.column_stack([random.uniform(-30, 30, (500, 2)), random.uniform(65, 75, 500)])
    amount = strength * np.exp(-0.5 * (((points[:, :2] - [8, -4]) / 12) ** 2).sum(1))
    moved = points + amount[:, None] * DIRECTION
    rays = moved[:, :2] / moved[:, 2:] + random.normal(0, noise_px / FOCAL_PX, (500, 2))
    return rays, rays - points[:, :2] / points[:, 2:], moved[:, 2] / points[:, 2] - 1


def test_pull_estimates_approach_of_pulled_tissue() -> None:
    pictures = [pulled(strength, seed) for seed, strength in enumerate((5.0, 6.0, 6.5))]
    pull = pull_of([each[0] for each in pictures], [each[1] for each in pictures], [np.eye(3)] * 3, FOCAL_PX)
    assert pull is not None
    assert pull.error_px < 0.5
    assert abs(pull.direction @ DIRECTION) > 0.995
    rays, off, nearer = pictures[2]
    along, unexplained = pull.along(rays, off)
    assert nearer.min() < -0.06
    assert np.median(np.abs(along - nearer)) < 0.004
    assert np.percentile(np.abs(along - nearer), 95) < 0.02
    assert np.median(unexplained) * FOCAL_PX < 0.5


def test_pull_direction_follows_camera_rotation() -> None:
    angle = 0.2
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    pictures = [pulled(6.0, seed) for seed in (0, 1)]
    rays, off = [each[0] for each in pictures], [each[1] for each in pictures]
    straight, turned = (pull_of(rays, off, [each] * 2, FOCAL_PX) for each in (np.eye(3), turn))
    assert straight is not None
    assert turned is not None
    assert abs(turned.direction @ turn @ straight.direction) == pytest.approx(1, abs=1e-6)


def test_pull_none_for_still_tissue_and_random_motion() -> None:
    rays, off, _ = pulled(0.0, 0)
    assert pull_of([rays], [off], [np.eye(3)], FOCAL_PX) is None
    anywhere = np.random.default_rng(1).normal(0, 6 / FOCAL_PX, off.shape)
    assert pull_of([rays], [anywhere], [np.eye(3)], FOCAL_PX) is None


def test_pull_along_line_of_sight_has_sign_of_motion() -> None:
    rays = np.array([[0.2, 0.0]])
    for sign in (1, -1):
        along, unexplained = Pull(sign * np.array([0.0, 0.0, 1.0]), 0.1).along(rays, np.array([[0.02, 0.0]]))
        # What comes nearer moves away from the middle of the picture.
        assert along[0] == pytest.approx(-0.1, rel=0.1)
        assert unexplained[0] < 0.002


def test_pull_direction_robust_to_wrong_tracks() -> None:
    """Wrongly tracked points move in a different direction and farther than the tissue."""
    rays, off, _ = pulled(6.0, 3)
    random = np.random.default_rng(8)
    wrong = random.choice(len(rays), 12, replace=False)
    off[wrong] = random.normal([-3, 8], 3, (len(wrong), 2)) / FOCAL_PX
    pull = pull_of([rays], [off], [np.eye(3)], FOCAL_PX)
    assert pull is not None
    assert abs(pull.direction @ DIRECTION) > 0.99
