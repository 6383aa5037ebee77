"""Planes from sums over windows: exact for planes, and level where nothing speaks for a slope."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth.plane_fits import at_middles, terms_of


def summed(x, y, values, weight) -> tuple[np.ndarray, ...]:
    """Return the terms of `terms_of`, each summed over one window."""
    return tuple(np.array([[term.sum()]]) for term in terms_of(weight, x, y, values))


@pytest.mark.parametrize("seed", range(3))
def test_at_middles_of_plane_is_exact(seed):
    rng = np.random.default_rng(seed)
    x, y, weight = rng.uniform(-3, 5, (3, 20))
    a, b, c = rng.normal(size=3)
    found = at_middles(summed(x, y, a + b * x + c * y, np.abs(weight) + 0.1), np.array(0.7), np.array(-1.2), 0.0)
    assert found == pytest.approx(a + 0.7 * b - 1.2 * c, abs=1e-6)


def test_at_middles_with_large_damping_is_mean():
    x = np.arange(5.0)
    sums = summed(x, np.zeros(5), 2 * x, np.ones(5))
    assert at_middles(sums, np.array(4.0), np.array(0.0), 1e9) == pytest.approx(4.0, abs=1e-6)
    assert at_middles(sums, np.array(4.0), np.array(0.0), 1e-9) == pytest.approx(8.0, abs=1e-6)


def test_at_middles_without_data_is_finite():
    nothing = tuple(np.zeros((2, 2)) for _ in range(9))
    assert np.isfinite(at_middles(nothing, np.ones((2, 2)), np.ones((2, 2)), 0.01)).all()
