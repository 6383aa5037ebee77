"""Parts of the periodic fit: its minimum and errors by finite differences, the search of frequencies, shared deviations."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.experimental import periodic_motion
from gsplat_core.experimental.periodic_motion import (
    PeriodicMotion,
    fitted,
    found_in,
    off_px,
    smoothness,
    splines,
    together_px,
    waves,
)
from gsplat_core.geometry.grid_tracks import GridTracks
from tests.gsplat_core.experimental.test_periodic_motion import seen
from tests.gsplat_core.geometry.breathing_points import BREATHING_HZ, EXTENT, FOCAL_PX


def test_smoothness_is_sum_of_squared_second_differences():
    values = np.random.default_rng(0).normal(size=(5, 4))
    across = sum((values[i - 1, j] - 2 * values[i, j] + values[i + 1, j]) ** 2 for i in range(1, 4) for j in range(4))
    down = sum((values[i, j - 1] - 2 * values[i, j] + values[i, j + 1]) ** 2 for i in range(5) for j in range(1, 3))
    assert values.ravel() @ smoothness((5, 4)) @ values.ravel() == pytest.approx(across + down)


def bends(grid: tuple[int, int]) -> np.ndarray:
    """Return the matrix of the sum of squared second differences on a grid, by polarisation."""
    unit = np.eye(grid[0] * grid[1]).reshape(-1, *grid)
    second = [np.diff(unit, 2, axis=axis).reshape(len(unit), -1) for axis in (1, 2)]
    return second[0] @ second[0].T + second[1] @ second[1].T


@pytest.mark.parametrize("hz", [(), (BREATHING_HZ,)])
def test_periodic_fit_minimises_robust_cost_and_estimates_errors(hz):
    """Residuals have a Cauchy scale of 0.5 pixels and an error of 0.35, three in sequence count as one, depth is within a
    half of the median, vectors within 4 % of it and within 0.8 % of their neighbours. Errors of depth are tripled.
    """
    whole, points = seen(4.0)
    tracks, grid = whole.of(np.arange(0, 300, 8), np.arange(0, 40, 2)), (4, 4)
    begin = points[0, ::8]
    motion = fitted(tracks, hz, begin, rounds=50, nodes=grid)
    pose, count, terms = tracks.poses[10], len(begin), 2 * len(hz)
    rest = motion.terms[:, :, 0]
    local = rest @ pose[:3, :3].T + pose[:3, 3]
    place = (local[:, :2] / local[:, 2:] / EXTENT / 2 + 0.5 + 0.15) / 1.3
    across, down = (splines(place[:, axis], 4) for axis in (0, 1))
    nodes = (across[:, :, None] * down[:, None, :]).reshape(count, -1)
    begun = begin @ pose[2, :3] + pose[2, 3]
    distance = float(np.median(begun))
    stiff = bends(grid) / (0.008 * distance) ** 2 + np.eye(16) / (0.04 * distance) ** 2
    vectors = motion.terms[:, :, 1:].reshape(count, -1)
    field = np.linalg.solve(nodes.T @ nodes + 1e-9 * stiff, nodes.T @ vectors)  # the least of those with these vectors
    np.testing.assert_allclose(nodes @ field, vectors, atol=2e-3)
    start = np.concatenate([rest.ravel(), field.ravel()])

    def residuals(x: np.ndarray) -> np.ndarray:
        vectors = (nodes @ x[3 * count :].reshape(16, -1)).reshape(count, 3, terms)
        at = x[: 3 * count].reshape(count, 3) + np.einsum("njb,tb->tnj", vectors, waves(tracks.times_s, hz)[:, 1:])
        return off_px(at, tracks)

    off = residuals(start)
    by = np.stack([(residuals(start + step) - residuals(start - step)) / 2e-4 for step in 1e-4 * np.eye(len(start))])
    weight = tracks.seen / (1 + (off**2).sum(2) / 0.25) / (0.35**2 * 3)
    by, weighted = by.reshape(len(start), -1), (by * weight[..., None]).reshape(len(start), -1)
    prior, pull = np.zeros((len(start), len(start))), np.zeros(len(start))
    known = 1 / (0.5 * distance) ** 2
    for number in range(count):
        block = slice(3 * number, 3 * number + 3)
        prior[block, block] = known * (np.outer(pose[2, :3], pose[2, :3]) + 1e-3 * np.eye(3))
        pull[block] = known * 1.001 * (local[number, 2] - distance) * pose[2, :3]
    prior[3 * count :, 3 * count :] = np.kron(stiff, np.eye(3 * terms))
    pull[3 * count :] = (stiff @ field).ravel()
    hessian = weighted @ by.T + prior
    step = np.linalg.solve(hessian, weighted @ off.ravel() + pull)
    change = np.abs(np.concatenate([step[: 3 * count], (nodes @ step[3 * count :].reshape(16, -1)).ravel()]))
    assert np.quantile(change, 0.9) < 1e-3 * distance and np.median(change) < 1e-5 * distance
    assert motion.cost == pytest.approx(float(np.log1p((off**2).sum(2) / 0.25)[tracks.seen].mean()), rel=1e-3)
    spread = np.linalg.inv(hessian)
    errors = [pose[2, :3] @ spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] @ pose[2, :3] for k in range(count)]
    ratio = motion.error / (3 * np.sqrt(errors) / distance)
    assert np.mean(np.abs(ratio - 1) < 0.01) > 0.9  # points with outliers do not converge


def test_periodic_fit_starts_at_best_common_distance():
    """Seen from two places, on a sphere about the first one, and without turning."""
    rays = np.random.default_rng(1).uniform(-0.4, 0.4, (30, 2))
    poses = np.stack([np.eye(4)] * 3)
    poses[1, :3, 3], poses[2, :3, 3] = [-4, 1, 0], [2, 3, -1]
    at = np.c_[rays, np.ones(30)] * 50
    local = at + poses[:, None, :3, 3]
    visible = np.ones((3, 30), bool)
    visible[0, :5] = False
    tracks = GridTracks(local[..., :2] / local[..., 2:], visible, poses, np.arange(3.0), FOCAL_PX, EXTENT)
    found = periodic_motion._at_one_distance(tracks)
    np.testing.assert_allclose(found[5:], at[5:], rtol=0.02)
    still = GridTracks(tracks.rays[[0, 0]], visible[[1, 1]], poses[[0, 0]], np.arange(2.0), FOCAL_PX, EXTENT)
    assert np.isfinite(periodic_motion._at_one_distance(still)).all()


def test_periodic_fit_limits_depths_to_quarter_and_four_times_median():
    whole, points = seen(2.0)
    tracks = whole.of(slice(0, 9))
    fit = periodic_motion._Fit(tracks, (), points[0, :9], (4, 4))
    pose = tracks.poses[len(tracks.poses) // 2]
    depths = np.array([0.1, 0.24, 0.26, 1, 3.9, 4.1, 90, -1, 1]) * fit._distance
    local = np.c_[np.random.default_rng(2).uniform(-0.3, 0.3, (9, 2)), np.ones(9)] * depths[:, None]
    limited = fit._limited((local - pose[:3, 3]) @ pose[:3, :3]) @ pose[:3, :3].T + pose[:3, 3]
    expected = np.clip(depths, 0.25 * fit._distance, 4 * fit._distance)
    np.testing.assert_allclose(limited[:, 2], expected)
    ahead = depths > 0
    np.testing.assert_allclose((limited[:, :2] / limited[:, 2:])[ahead], (local[:, :2] / local[:, 2:])[ahead])


def test_together_px_averages_deviations_over_24_pixels_robustly():
    """Against sums over all observations of a picture, whose positions are the centres of cells of 4 pixels."""
    random = np.random.default_rng(4)
    cells = random.integers(0, [70, 55], (2, 60, 2))
    half = np.array(EXTENT) * FOCAL_PX
    pixels = 4.0 * cells + 2
    off = random.normal(0, 2, (2, 60, 2)) + [1.0, -0.5]
    off[:, :6] = [40.0, 0]
    visible = random.random((2, 60)) > 0.2
    tracks = GridTracks(
        (pixels - half) / FOCAL_PX, visible, np.stack([np.eye(4)] * 2), np.arange(2.0), FOCAL_PX, EXTENT
    )
    found = together_px(off, tracks)
    for picture in range(2):
        apart = ((pixels[picture][:, None] - pixels[picture]) ** 2).sum(2)
        trust = visible[picture] / (1 + (off[picture] ** 2).sum(1) / 64)
        near = np.exp(-0.5 * apart / 24**2) * trust
        expected = np.linalg.norm(near @ off[picture] / near.sum(1, keepdims=True), axis=1)
        np.testing.assert_allclose(found[picture], expected, rtol=0.05, atol=0.02)


def valley(hz: float, at: float, deep: float, wide: float = 0.1) -> float:
    return deep * max(0.0, 1 - abs(hz - at) / wide)


@pytest.fixture
def search(monkeypatch):
    """Return the frequencies found and tried, in a recording where they have given costs, and tissue at rest costs 1."""

    def found(cost, length_s: float = 12.0, times: int = 120, points: int = 900, depth=lambda hz: 50.0):
        tried = []

        def fit(tracks, hz, begin=None, rounds=8, nodes=None):
            tried.append((hz, tracks.rays.shape[:2]))
            rest = np.tile([0.0, 0.0, depth(hz)], (tracks.rays.shape[1], 1))
            return PeriodicMotion(hz, rest[:, :, None], np.zeros(len(rest)), cost(hz) if hz else 1.0)

        monkeypatch.setattr(periodic_motion, "fitted", fit)
        tracks = GridTracks(
            np.zeros((times, points, 2)), np.ones((times, points), bool), np.stack([np.eye(4)] * times),
            np.linspace(1, 1 + length_s, times), FOCAL_PX, EXTENT,
        )  # fmt: skip
        return found_in(tracks), tried

    return found


@pytest.mark.parametrize(("deep", "hz"), [(0.09, ()), (0.11, (0.3,))])
def test_frequency_search_accepts_breathing_lowering_cost_by_tenth(search, deep, hz):
    found, _ = search(lambda each: 1 - valley(each[0], 0.3, deep))
    assert found.hz == pytest.approx(hz, abs=0.002)


@pytest.mark.parametrize(("deep", "hz"), [(0.03, (0.3,)), (0.05, (0.3, 1.2))])
def test_frequency_search_accepts_heart_lowering_cost_by_four_percent(search, deep, hz):
    found, _ = search(
        lambda each: (1 - valley(each[0], 0.3, 0.5)) * (1 - (valley(each[1], 1.2, deep) if len(each) > 1 else 0))
    )
    assert found.hz == pytest.approx(hz, abs=0.002)


@pytest.mark.parametrize(
    ("length_s", "times", "slowest", "fastest"), [(12.0, 95, 0.1, 1.57), (4.0, 48, 0.15, 3.0), (12.0, 48, 0.1, 1.57)]
)
def test_frequency_search_steps_are_quarter_cycles(search, length_s, times, slowest, fastest):
    """From 0.6 cycles on, and the heart from 0.8 Hz to 3 or two fifths of the rate of the 48 times and 400 points used."""
    _, tried = search(lambda each: 1 - valley(each[0], 0.4, 0.5, 0.4), length_s, times)
    assert {shape for _, shape in tried} == {(48, 400)}
    breaths = np.array([hz[0] for hz, _ in tried if len(hz) == 1])
    grid = breaths[: int(np.argmax(np.diff(breaths) < 0)) + 1]
    assert grid[0] == pytest.approx(slowest) and 0.8 - 0.25 / length_s - 1e-9 <= grid[-1] < 0.8
    np.testing.assert_allclose(np.diff(grid), 0.25 / length_s)
    beats = np.array([hz[1] for hz, _ in tried if len(hz) == 2])
    assert beats[0] == 0.8 and fastest - 0.25 / length_s - 0.01 <= beats[-1] < fastest
    np.testing.assert_allclose(np.diff(beats), 0.25 / length_s)


def test_frequency_search_uses_short_and_small_tracks_whole(search):
    _, tried = search(lambda each: 1.0, 3.0, times=30, points=50)
    assert {shape for _, shape in tried} == {(30, 50)}


def test_frequency_search_refines_within_bands(search):
    off = lambda each: 1 - valley(each[0], 0.317, 0.5) - (valley(each[1], 1.234, 0.2) if len(each) > 1 else 0)
    found, _ = search(off)
    assert found.hz == pytest.approx((0.317, 1.234), abs=0.0015)
    assert search(lambda each: 1 - valley(each[0], 0.05, 0.9, 0.5))[0].hz == pytest.approx((0.1,))


def test_frequency_search_error_is_largest_depth_change_within_six_percent_cost(search):
    """The cost rises by 6 % over 0.006 Hz, and the depth changes by 1 % per 0.001 Hz."""
    found, _ = search(
        lambda each: 0.5 + 5.0 * abs(each[0] - 0.3) if len(each) == 1 else 2.0,
        depth=lambda hz: 50 * (1 + 10 * (hz[0] - 0.3)) if hz else 50.0,
    )
    assert found.hz == pytest.approx((0.3,), abs=0.0015) and 0.04 < found.error < 0.065


@pytest.mark.parametrize(("pulled", "used"), [(6, False), (8, True)])
def test_fitted_undisturbed_keeps_three_tenths_of_observations_at_least(monkeypatch, pulled, used):
    """Some of the ten observations of each point deviate by a pixel. The motion is fitted again without them."""
    tracks = GridTracks(
        np.zeros((10, 5, 2)), np.ones((10, 5), bool), np.stack([np.eye(4)] * 10), np.arange(10.0), FOCAL_PX, EXTENT
    )
    motion = PeriodicMotion((0.3,), np.ones((5, 3, 3)), np.zeros(5), 1.0)
    far = np.zeros((10, 5))
    far[:pulled], far[pulled:] = 0.52, 0.48
    masks = []
    monkeypatch.setattr(periodic_motion, "together_px", lambda off, tracks: far)
    monkeypatch.setattr(periodic_motion, "fitted", lambda tracks, hz, begin: masks.append(tracks.seen) or motion)
    assert periodic_motion.fitted_undisturbed(tracks, motion) is motion
    assert len(masks) == 2
    for mask in masks:
        assert (mask[:pulled] == used).all() and mask[pulled:].all()
