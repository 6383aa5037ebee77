"""Fits of planes with windows, in closed form: regularisation, supports, limits and what exceeds noise."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth import plane_fits
from gsplat_core.depth.plane_fits import at_middles, surface_through, terms_of


def sums_of(weight, x, y, values):
    """Return the moments of points in one window."""
    return tuple(np.array([[float(each.sum())]]) for each in terms_of(*map(np.asarray, (weight, x, y, values))))


def at(x, y):
    return np.array([[float(x)]]), np.array([[float(y)]])


def test_at_middles_damps_slopes_relative_to_variance():
    """Four points at ±1 in both directions have a variance of 1 along each; their values rise by 2 and 3."""
    x, y = np.array([-1.0, 1, -1, 1]), np.array([-1.0, -1, 1, 1])
    sums = sums_of(np.ones(4), x, y, 10 + 2 * x + 3 * y)
    assert at_middles(sums, *at(1, 1), 0.0)[0, 0] == pytest.approx(15)
    assert at_middles(sums, *at(1, 0), 0.0)[0, 0] == pytest.approx(12)
    assert at_middles(sums, *at(1, 1), 1.0)[0, 0] == pytest.approx(12.5), "half of the slopes"
    assert at_middles(sums, *at(1, 1), 0.0, 0.5)[0, 0] == pytest.approx(12.5), "half of the sum of variances is 1"


def test_at_middles_uses_weighted_mean():
    x, y = np.array([0.0, 4.0]), np.array([1.0, 1.0])
    sums = sums_of(np.array([3.0, 1.0]), x, y, np.array([0.0, 8.0]))
    assert at_middles(sums, *at(1, 1), 1e9)[0, 0] == pytest.approx(2)
    assert at_middles(sums, *at(3, 1), 1e-9)[0, 0] == pytest.approx(6, rel=1e-3)


def test_at_middles_equals_weighted_least_squares():
    rng = np.random.default_rng(0)
    x = rng.normal(size=50)
    y, weight, values = 0.8 * x + 0.3 * rng.normal(size=50), rng.uniform(0.5, 2, 50), rng.normal(size=50)
    terms = np.stack([np.ones(50), x, y], 1) * np.sqrt(weight)[:, None]
    best = np.linalg.lstsq(terms, values * np.sqrt(weight), rcond=None)[0]
    found = at_middles(sums_of(weight, x, y, values), *at(0.7, -0.4), 0.0)[0, 0]
    assert found == pytest.approx(best @ [1, 0.7, -0.4])


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_at_middles_of_one_or_no_point_is_finite(weight):
    sums = sums_of(np.array([weight]), np.array([2.0]), np.array([3.0]), np.array([7.0]))
    assert at_middles(sums, *at(5, 5), 0.0)[0, 0] == pytest.approx(7 * weight)


def plane_points(count=600, size=(61, 80)):
    """Return points of a plane of the world, whose inverse depth is linear in the picture."""
    pixels = np.random.default_rng(0).uniform([0, 0], size[::-1], (count, 2))
    return pixels, 1 / (0.02 + 1e-4 * pixels[:, 0] - 5e-5 * pixels[:, 1])


def test_surface_through_plane_points_is_plane():
    pixels, depth = plane_points()
    found, error, support = surface_through(pixels, depth, np.full(len(depth), 0.03), (61, 80))
    y, x = np.mgrid[:61, :80] + 0.5
    expected = 1 / (0.02 + 1e-4 * x - 5e-5 * y)
    assert found.shape == error.shape == support.shape == (61, 80)
    assert np.abs(found / expected - 1)[4:-4, 4:-4].max() < 0.01 and np.abs(found / expected - 1).max() < 0.03
    np.testing.assert_allclose(error, 0.03)
    np.testing.assert_allclose(support[5:-5, 5:-5], 1)


def test_surface_through_weights_by_inverse_squared_error():
    """The floor of 0.5 % bounds the weight of points without an error."""
    pixels = np.repeat(np.random.default_rng(0).uniform([0, 0], [80, 60], (300, 2)), 2, 0)
    depth, error = np.tile([50.0, 100.0], 300), np.tile([0.01, 0.03], 300)
    found, mean_error, _ = surface_through(pixels, depth, error, (60, 80))
    weights = 1 / (np.array([0.01, 0.03]) ** 2 + 0.005**2)
    weights /= weights.sum()
    assert found[30, 40] == pytest.approx(1 / (weights @ [1 / 50, 1 / 100]), rel=0.03)
    assert mean_error[30, 40] == pytest.approx(weights @ [0.01, 0.03], rel=0.03)


def test_surface_support_window_is_nine_pixels():
    one = np.array([[40.5, 30.5]])
    found, error, support = surface_through(one, np.array([50.0]), np.array([0.02]), (60, 80))
    np.testing.assert_allclose(found, 50)
    np.testing.assert_allclose(error, 0.02)
    # The weights of a window sum to 1 over its 2 pi 9² pixels.
    assert support[30, 40] == pytest.approx(1 / 1.5, rel=0.05)
    assert support[30, 49] / support[30, 40] == pytest.approx(np.exp(-0.5), rel=0.1)


@pytest.mark.parametrize(
    ("pixel", "is_inside"),
    [((0.0, 0.0), True), ((-0.1, 5), False), ((5, -0.1), False), ((79.9, 59.9), True), ((80.0, 5), False), ((5, 60.0), False)],
)  # fmt: skip
def test_surface_through_ignores_points_outside_picture(pixel, is_inside):
    found, error, support = surface_through(np.array([pixel]), np.array([50.0]), np.array([0.02]), (60, 80))
    np.testing.assert_allclose(found, 50)
    assert (support.max() > 0) == is_inside and (error == 1).all() == (not is_inside)


def test_surface_through_no_points_is_one_without_support():
    found, error, support = surface_through(np.zeros((0, 2)), np.zeros(0), np.zeros(0), (20, 30))
    assert (found == 1).all() and (error == 1).all() and not support.any()


def test_surface_through_extrapolates_at_most_by_half():
    x = np.repeat(np.arange(30.0, 50, 2), 10)
    y = np.tile(np.arange(20.0, 40, 2), 10)
    inverse = 0.01 + 0.002 * (x - 30)
    found, _, _ = surface_through(np.stack([x, y], 1), 1 / inverse, np.full(100, 0.01), (60, 80))
    low, high = np.percentile(inverse, [1, 99])
    assert found.max() == pytest.approx(1.5 / low) and found.min() == pytest.approx(1 / (1.5 * high))


def test_share_beyond_noise():
    """Residuals of twice the noise have four times its variance."""
    rng = np.random.default_rng(0)
    weight, noise = np.ones((80, 120), np.float32), rng.normal(0, 1, (80, 120)).astype(np.float32)
    for factor, share in ((0.5, 0.0), (1.0, 0.0), (2.0, 0.75), (10.0, 0.99)):
        found = plane_fits.share_beyond_noise(factor * noise, weight, 1.0)
        assert found[10:-10, 10:-10].mean() == pytest.approx(share, abs=0.08)
        assert found.min() >= 0 and found.max() <= 1
    assert not plane_fits.share_beyond_noise(np.zeros((80, 120), np.float32), weight, 1.0).any()


@pytest.mark.parametrize("shape", [(80, 120), (120, 80), (12, 9)])
def test_fitted_planes_of_plane(shape):
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    values, weight = 5 + 0.02 * x - 0.03 * y, np.ones(shape, np.float32)
    found = plane_fits.fitted_planes(values, weight, plane_fits.WINDOW)
    ratio = found / values  # a fiftieth less, as where little is known
    assert found.shape == shape and 0.9 < ratio.min() < 0.99 and ratio.max() < 1.01
    assert np.abs(np.median(ratio) - 1 / 1.02) < 0.005
    weight[:, : shape[1] // 2] = 0
    assert np.isfinite(plane_fits.fitted_planes(values, weight, plane_fits.WINDOW)).all()


def test_whole_plane_is_least_squares_and_level_for_few_values():
    y, x = np.mgrid[:20, :30].astype(np.float32)
    values, weight = 1 + 0.1 * x - 0.05 * y, np.ones((20, 30), np.float32)
    np.testing.assert_allclose(plane_fits._whole_plane(values, weight), values, rtol=1e-3)
    weight[:] = 0
    weight[10, 10:12] = 1
    found = plane_fits._whole_plane(values, weight)
    assert np.ptp(found) < 0.5 * np.ptp(values) and found[10, 10] == pytest.approx(values[10, 10], rel=0.05)


def test_surface_through_sparse_points_uses_24_pixel_window():
    """The mean error at a pixel tells the weights of the two points. Both are too far for the narrow window."""
    pixels, errors = np.array([[25.0, 41.0], [105.0, 41.0]]), np.array([0.01, 0.05])
    _, found, support = surface_through(pixels, np.array([50.0, 60.0]), errors, (82, 130))
    weights = 1 / (errors**2 + 0.005**2)
    for column in (60, 70, 80):
        away = column + 0.5 - pixels[:, 0]
        near = weights * np.exp(-0.5 * (away / 24) ** 2)
        assert support[41, column] < 0.03
        assert found[41, column] == pytest.approx(near @ errors / near.sum(), rel=0.06)
