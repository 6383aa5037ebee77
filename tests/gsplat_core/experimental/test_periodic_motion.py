"""Breathing tissue before a swaying scope, whose distances are known."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.experimental.periodic_motion import (
    PeriodicMotion,
    fitted,
    found_in,
    in_cameras,
    off_px,
    splines,
    waves,
)
from gsplat_core.geometry.grid_tracks import GridTracks
from tests.gsplat_core.geometry.breathing_points import (
    BREATHING_HZ,
    EXTENT,
    FOCAL_PX,
    HEART_HZ,
    places,
    swaying,
    tracks_of,
)

TRUE = BREATHING_HZ, HEART_HZ


def seen(
    length_s: float = 5.0, breathes: float = 1.0, reach: float = 1.0, noise_px: float = 0.2
) -> tuple[GridTracks, np.ndarray]:
    times_s = np.arange(0, length_s, 0.1)
    points, poses = places(times_s, breathes), swaying(times_s, reach)
    return tracks_of(points, poses, times_s, noise_px), points


def relative_errors(motion: PeriodicMotion, tracks: GridTracks, points: np.ndarray) -> np.ndarray:
    """Return relative errors of the distance from the camera [T, N]."""
    found, true = in_cameras(motion.at(tracks.times_s), tracks.poses), in_cameras(points, tracks.poses)
    return np.abs(found[..., 2] / true[..., 2] - 1)


@pytest.mark.slow
def test_periodic_fit_distances_of_breathing_tissue() -> None:
    tracks, points = seen()
    moving = fitted(tracks, TRUE)
    assert np.median(relative_errors(moving, tracks, points)) < 0.008
    assert np.median(moving.error) < 0.03
    still = fitted(tracks, ())
    assert np.median(relative_errors(still, tracks, points)) > 0.03
    assert moving.cost < 0.3 * still.cost


@pytest.mark.slow
def test_periodic_fit_distances_unbiased_by_noise() -> None:
    tracks, points = seen(noise_px=0.5)
    found = in_cameras(fitted(tracks, TRUE).at(tracks.times_s), tracks.poses)[..., 2]
    assert abs(np.median(found / in_cameras(points, tracks.poses)[..., 2]) - 1) < 0.01


@pytest.mark.slow
def test_periodic_fit_robust_to_temporary_pull() -> None:
    tracks, points = seen()
    pulled = tracks.rays.copy()
    pulled[10:20, :60] += 0.05
    moving = fitted(GridTracks(pulled, tracks.seen, tracks.poses, tracks.times_s, tracks.focal_px, tracks.extent), TRUE)
    assert np.median(relative_errors(moving, tracks, points)[:, :60]) < 0.015
    off = np.linalg.norm(off_px(moving.at(tracks.times_s), tracks), axis=2)
    assert np.median(off) < 0.5


@pytest.mark.slow
def test_periodic_fit_finds_frequencies() -> None:
    tracks, _ = seen()
    found = found_in(tracks)
    assert found.hz == pytest.approx(TRUE, abs=0.01)
    assert found.error < 0.03


def test_periodic_fit_still_tissue_has_no_frequency() -> None:
    tracks, points = seen(breathes=0.0)
    assert found_in(tracks).hz == ()
    assert np.median(relative_errors(fitted(tracks, ()), tracks, points)) < 0.005


@pytest.mark.parametrize(("length_s", "reach"), [(1.2, 1.0), (5.0, 0.02)], ids=["short", "hardly moving"])
@pytest.mark.slow
def test_periodic_fit_reports_large_error_of_undetermined_distances(length_s: float, reach: float) -> None:
    tracks, _ = seen(length_s, reach=reach)
    found = found_in(tracks)
    error = np.hypot(np.median(fitted(tracks, found.hz or TRUE).error), found.error)
    assert error > 0.04


def of_order(order: int, number: int, x: float) -> float:
    """Value of a B-spline with knots at the integers, by Cox and de Boor's recursion."""
    if order == 1:
        return float(number <= x < number + 1)
    below, above = of_order(order - 1, number, x), of_order(order - 1, number + 1, x)
    return ((x - number) * below + (number + order - x) * above) / (order - 1)


@pytest.mark.parametrize("count", [4, 7])
def test_splines_equal_cox_de_boor_recursion(count: int) -> None:
    share = np.array([-0.3, 0.0, 0.1, 0.37, 0.5, 0.8, 0.99])
    places = share.clip(0, 1) * (count - 3) + 3
    np.testing.assert_allclose(splines(share, count), [[of_order(4, n, x) for n in range(count)] for x in places])
    np.testing.assert_allclose(splines(np.array([1.0, 2.0]), count)[:, -3:], [[1 / 6, 4 / 6, 1 / 6]] * 2)


def test_waves_start_with_constant_term() -> None:
    found = waves(np.array([0.0, 0.5]), (1.0,))
    np.testing.assert_allclose(found, [[1, 1, 0], [1, -1, 0]], atol=1e-12)


def test_periodic_fit_is_deterministic() -> None:
    tracks, _ = seen()
    assert fitted(tracks, TRUE, rounds=3).terms.tobytes() == fitted(tracks, TRUE, rounds=3).terms.tobytes()


def test_periodic_fit_unobserved_points_get_median_distance() -> None:
    """The median distance is that of the others. Sideways nothing is known, so that only the start counts."""
    tracks, points = seen(breathes=0.0)
    seen_by = tracks.seen.copy()
    seen_by[:, :20] = False
    tracks = GridTracks(tracks.rays, seen_by, tracks.poses, tracks.times_s, tracks.focal_px, tracks.extent)
    middle = tracks.poses[len(tracks.poses) // 2]
    begin = points[0].copy()
    begin[:20] += 5 * middle[2, :3]  # farther away, along the axis of the middle pose
    rest = fitted(tracks, (), begin, 1).at(np.zeros(1))[0]
    found, begun = (each @ middle[:3, :3].T + middle[:3, 3] for each in (rest, begin))
    usual = np.median(begun[:, 2])
    np.testing.assert_allclose(found[:20, 2], usual, rtol=1e-6)
    np.testing.assert_allclose(found[:20, :2], begun[:20, :2], rtol=1e-6, atol=1e-6)


def test_periodic_fit_motion_varies_over_narrow_view() -> None:
    """Opposite sides of the picture move in opposite directions. The view is a fifth as wide as elsewhere."""
    times_s = np.arange(0, 4, 0.1)
    rest, poses = places(times_s, 0.0)[0] * [0.2, 0.2, 1.0], swaying(times_s, 0.2)
    points = np.repeat(rest[None], len(times_s), 0)
    points[..., 0] += rest[:, 0] / 7 * np.cos(2 * np.pi * BREATHING_HZ * times_s)[:, None]
    local = in_cameras(points, poses)
    across, down = EXTENT
    tracks = GridTracks(
        local[..., :2] / local[..., 2:], np.ones(local.shape[:2], bool), poses, times_s, 5 * FOCAL_PX,
        (across / 5, down / 5),
    )  # fmt: skip
    found = fitted(tracks, (BREATHING_HZ,), rest, 2).terms[:, 0, 1]
    np.testing.assert_allclose(found, rest[:, 0] / 7, atol=0.1)
