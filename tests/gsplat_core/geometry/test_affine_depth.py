"""A factor and a summand are found by other depth whatever part of it is wrong, and do not wear down from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth import learned
from gsplat_core.depth.learned import LEAST_VALUES, MOST_SPAN, fitted, is_constant, with_assumed_zero

COUNT = 2000


@pytest.fixture
def values(rng):
    return rng.normal(3.0, 1.0, COUNT)


@pytest.mark.parametrize("factor", [3.0, -0.2])
def test_fitted_recovers_factor_and_summand(values, factor):
    found = fitted(values, factor * values + 5)
    assert found is not None
    assert found[:2] == pytest.approx((factor, 5)) and found.alike == pytest.approx(np.sign(factor))
    assert found.of(values) == pytest.approx(factor * values + 5)


@pytest.mark.parametrize("wrong", ["another place", "anything"])
def test_fitted_tolerates_a_fifth_of_outliers(values, rng, wrong):
    known = 3 * values + 5
    part = slice(0, COUNT // 5)
    known[part] = known[part] + 30 if wrong == "another place" else 20 * rng.normal(size=COUNT // 5)
    found = fitted(values, known)
    assert found is not None and found[:2] == pytest.approx((3, 5), rel=1e-6)


def test_fitted_repeatedly_on_noise_keeps_relief(values, rng):
    last = values.copy()
    for _ in range(200):
        seen = (values + 0.1 * rng.normal(size=COUNT)) * rng.uniform(0.5, 2) + rng.normal()
        found = fitted(seen, last)
        assert found is not None
        last = found.of(seen)
    assert last.std() == pytest.approx(values.std(), rel=0.05) and last.mean() == pytest.approx(3.0, abs=0.1)


def test_fitted_alike_is_small_for_unrelated_values(values, rng):
    found = fitted(values, rng.normal(size=COUNT))
    assert found is not None and abs(found.alike) < 0.4


def test_fitted_is_none_for_few_or_constant_values(values):
    few = values[: LEAST_VALUES - 1]
    assert fitted(few, few) is None
    assert fitted(values, np.full(COUNT, 7.0)) is None and fitted(np.full(COUNT, 7.0), values) is None


def test_fitted_tolerates_majority_of_equal_values(values):
    values[: COUNT * 2 // 3] = 2.0
    found = fitted(values, 2 * values)
    assert found is not None and found[:2] == pytest.approx((2, 0), abs=1e-6)


@pytest.mark.parametrize(
    ("values", "constant"),
    [
        (np.full(99, -4.0), True),
        (np.zeros(99), True),
        (np.linspace(4, 4.0001, 99), True),
        (np.linspace(4, 4.1, 99), False),
    ],
)
def test_is_constant_is_independent_of_scale(values, constant):
    assert is_constant(values) == is_constant(1e6 * values) == constant


def test_with_assumed_zero_limits_depth_span():
    assert with_assumed_zero(np.linspace(2, 4, 99)).summand == 0
    for low, high in ((0, 1), (-5, -1), (-3, 8), (0.1, 3)):
        moved = with_assumed_zero(np.linspace(low, high, 1001)).of(np.linspace(low, high, 1001))
        near, far = np.percentile(moved, (2, 98))
        assert near > 0 and far / near == pytest.approx(MOST_SPAN)


@pytest.mark.parametrize(
    ("given", "middle", "spread"),
    [([1.0, 2, 3, 4, 100], 3, 1), ([-5.0, -5, -1, 3, 3], -1, 4), ([2.0, 2, 2, 2, 12], 2, 4.0), ([7.0] * 5, 7, 0)],
)
def test_middle_returns_median_and_deviation(given, middle, spread):
    """The standard deviation stands in where more than half of the values are the median itself."""
    assert learned._middle(np.array(given)) == pytest.approx((middle, spread))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_by_medians_maps_median_and_deviation(sign):
    values, known = np.array([1.0, 2, 3, 4, 100]), np.array([10.0, 16, 20, 24, -900])
    found = learned._by_medians(values, known, sign)
    assert found.factor == pytest.approx(sign * 6) and found.of(np.array([3.0]))[0] == pytest.approx(16)


def test_weighted_spread_and_correlation_equal_repeated_values(rng):
    x, y, counts = rng.normal(2, 3, 30), rng.normal(-1, 2, 30), rng.integers(1, 5, 30)
    y += 0.5 * x
    many_x, many_y = np.repeat(x, counts), np.repeat(y, counts)
    assert learned._spread(x, counts) == pytest.approx((many_x.mean(), many_x.std()))
    assert learned._correlation(x, y, counts) == pytest.approx(np.corrcoef(many_x, many_y)[0, 1])
    assert learned._correlation(x, 0 * y, counts) == learned._correlation(0 * x, y, counts) == 0


@pytest.mark.parametrize(("count", "is_fitted"), [(LEAST_VALUES - 1, False), (LEAST_VALUES, True)])
def test_fitted_requires_minimum_number_of_values(count, is_fitted):
    values = np.linspace(1, 2, count)
    assert (fitted(values, 2 * values) is not None) == is_fitted


def test_fitted_is_exact_for_exact_values_of_any_scale(rng):
    """Differences of 0 give all values the same weight."""
    values = rng.normal(size=200)
    for size in (1e-6, 1.0, 1e6):
        found = fitted(values, size * (3 * values - 1))
        assert found is not None and found[:2] == pytest.approx((3 * size, -size)) and found.alike == pytest.approx(1)
    zero = np.where(np.arange(200) < 100, 0.0, values)
    assert fitted(zero, zero) is not None


@pytest.mark.parametrize(("low", "high", "summand"), [(1.0, 5.0, 0.0), (1.0, 9.0, 1.0), (0.0, 4.0, 1.0), (-1.0, 3.0, 2.0), (2.0, 3.0, 0.0)])  # fmt: skip
def test_with_assumed_zero_summand_for_given_range(low, high, summand):
    values = np.concatenate([np.full(100, low), np.full(100, high)])
    found = with_assumed_zero(values)
    assert found == (1.0, pytest.approx(summand), 1.0)
    ends = found.of(np.array([low, high]))
    assert ends[1] <= MOST_SPAN * ends[0] * (1 + 1e-9)
