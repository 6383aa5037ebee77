"""`fitted_undisturbed`: a temporary pull does not affect the periodic motion of breathing tissue."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.experimental.periodic_motion import PeriodicMotion, fitted, fitted_undisturbed, off_px, together_px
from gsplat_core.geometry.grid_tracks import GridTracks
from tests.gsplat_core.geometry.breathing_points import BREATHING_HZ, HEART_HZ, places, swaying, tracks_of

TIMES_S = np.arange(0, 5, 0.08)
HZ = (BREATHING_HZ, HEART_HZ)
PULL = np.array([2.3, 1.5, -6.0])
GRASPED = np.array([6.0, -3.0])


def pulled(points: np.ndarray) -> np.ndarray:
    """The points [T, N, 3], of which some near one place are pulled from 1.5 s to 3 s."""
    strength = np.sin(np.pi * np.clip((TIMES_S - 1.5) / 1.5, 0, 1)) ** 2
    near = np.exp(-0.5 * (((points[0, :, :2] - GRASPED) / 12) ** 2).sum(1))
    return points + (strength[:, None] * near)[..., None] * PULL


def distance_errors(motion: PeriodicMotion, points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Relative errors of z [T, N]."""
    z = [np.einsum("j,tnj->tn", [0, 0, 1], each @ poses[0, :3, :3].T) for each in (motion.at(TIMES_S), points)]
    return z[0] / z[1] - 1


@pytest.fixture(scope="module")
def breathing() -> np.ndarray:
    return places(TIMES_S, count=600)


@pytest.mark.slow
def test_fitted_undisturbed_reduces_error_of_pull(breathing) -> None:
    poses = swaying(TIMES_S)
    tracks = tracks_of(pulled(breathing), poses, TIMES_S)
    first = fitted(tracks, HZ)
    again = fitted_undisturbed(tracks, first)
    # Of the tissue as it would be without the pull, and at the times at which it is not pulled.
    before, after = (np.sqrt((distance_errors(each, breathing, poses) ** 2).mean()) for each in (first, again))
    assert after < 0.6 * before
    undisturbed = fitted(tracks_of(breathing, poses, TIMES_S), HZ)
    assert after < 1.6 * np.sqrt((distance_errors(undisturbed, breathing, poses) ** 2).mean())
    assert again.error.max() < 0.2, "each point keeps sightings that say how far away it is"


@pytest.mark.slow
def test_fitted_undisturbed_nearly_unchanged_without_pull(breathing) -> None:
    tracks = tracks_of(breathing, swaying(TIMES_S), TIMES_S)
    first = fitted(tracks, HZ, rounds=16)
    again = fitted_undisturbed(tracks, first)
    off = np.linalg.norm(first.at(TIMES_S) - again.at(TIMES_S), axis=2)
    assert np.median(off) < 0.02, "of 70"


def test_together_px_finds_common_deviation_of_neighbours() -> None:
    random = np.random.default_rng(0)
    rays = random.uniform(-0.5, 0.5, (2, 400, 2)) * [1.1, 0.9]
    seen = random.random((2, 400)) > 0.2
    tracks = GridTracks(rays, seen, np.tile(np.eye(4), (2, 1, 1)), np.arange(2.0), 280.0, (0.57, 0.45))
    off = random.normal(0, 0.5, (2, 400, 2))
    left = rays[..., 0] < 0
    off[1][left[1]] += [2.0, -1.0]
    off[:, ::40] = 60.0  # not found
    far = np.abs(rays[..., 0]) > 0.25
    together = together_px(off, tracks)
    assert together.shape == (2, 400)
    assert np.median(together[1][left[1] & far[1]]) == pytest.approx(np.hypot(2, 1), rel=0.1)
    assert together[0].max() < 0.9 and together[1][~left[1] & far[1]].max() < 0.9


@pytest.mark.slow
def test_fitted_undisturbed_finite_for_permanently_deviating_points() -> None:
    """All points in that area move unlike breathing, so no undisturbed neighbour exists."""
    points = places(TIMES_S)
    points[:, points[0, :, 0] > 20] += np.linspace(0, 9, len(TIMES_S))[:, None, None] ** 1.5 * [0.0, 1.0, 0.0]
    tracks = tracks_of(points, swaying(TIMES_S), TIMES_S)
    motion = fitted_undisturbed(tracks, fitted(tracks, HZ))
    assert np.isfinite(motion.terms).all() and np.isfinite(motion.error).all()
    assert np.isfinite(off_px(motion.at(TIMES_S), tracks)).all()


@pytest.mark.slow
def test_fitted_undisturbed_with_few_points_excludes_pull() -> None:
    """With few points, errors near the pulled point shrink and the remaining motion is unchanged."""
    points, poses = places(TIMES_S, count=90), swaying(TIMES_S)
    tracks = tracks_of(pulled(points), poses, TIMES_S)
    first = fitted(tracks, HZ, rounds=4)
    again = fitted_undisturbed(tracks, first)
    before, after = (np.sqrt((distance_errors(each, points, poses) ** 2).mean()) for each in (first, again))
    assert after < 0.75 * before


def test_together_px_assigns_outside_points_to_border_cells() -> None:
    random = np.random.default_rng(1)
    rays = random.uniform(-1.5, 1.5, (1, 300, 2))
    tracks = GridTracks(rays, np.ones((1, 300), bool), np.eye(4)[None], np.zeros(1), 280.0, (0.57, 0.45))
    together = together_px(np.broadcast_to([3.0, -4.0], (1, 300, 2)), tracks)
    np.testing.assert_allclose(together, 5.0, rtol=1e-6)
