"""Affine alignment of relative depth: scale and offset between a network's output and a reference
depth of the same picture.

All functions work on values that are either depth or inverse depth. The result is of the same kind
as the input.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float64]

MOST_SPAN = 5.0
"""Largest assumed ratio of the far end of a picture to its near end, when no reference depth fixes
the offset.
"""
ENDS = (2.0, 98.0)
"""Percentiles used as the near and far ends of a picture; values beyond them may be outliers."""
ROUNDS = 10
LEAST_VALUES = 64
CONSTANT = 1e-4
"""Ratio of spread to magnitude below which values count as constant."""


class Affine(NamedTuple):
    """Affine map `factor` · values + `summand`."""

    factor: float
    summand: float
    alike: float
    """Weighted correlation of the two aligned sides, -1 to 1; negative exactly when the factor is
    negative.
    """

    def of(self, values: Plane) -> Plane:
        """Apply the map to values of any shape."""
        return self.factor * values + self.summand


def is_constant(values: Plane) -> bool:
    """Return True if values [N] are effectively constant."""
    low, high = np.percentile(values, ENDS)
    return bool(high - low <= CONSTANT * max(abs(low), abs(high), 1e-30))


def with_assumed_zero(values: Plane) -> Affine:
    """Return the offset that limits the span of values [N] to `MOST_SPAN`; zero if the span is
    already smaller.

    Used when no reference depth is available.
    """
    low, high = np.percentile(values, ENDS)
    missing = (high - MOST_SPAN * low) / (MOST_SPAN - 1)
    return Affine(1.0, max(0.0, float(missing)), 1.0)


def fitted(values: Plane, known: Plane) -> Affine | None:
    """Fit the affine map from `values` [N] to `known` [N] robustly.

    Both sides have errors, so their spreads are made equal (reduced major axis regression). Least
    squares would flatten the relief a little at each fit, and depth that is fitted to the previous
    frame's depth would become flat over time. Outliers are suppressed by iteratively reweighted
    estimates with Cauchy weights.

    Args:
        values: float64 [N], the network's output.
        known: float64 [N], reference values at the same pixels.

    Returns:
        The map, or None for fewer than `LEAST_VALUES` values or when either side is constant.
    """
    if len(values) < LEAST_VALUES or is_constant(values) or is_constant(known):
        return None
    rising, falling = (_by_medians(values, known, sign) for sign in (1.0, -1.0))
    found = min(rising, falling, key=lambda each: float(np.median(np.abs(each.of(values) - known))))
    sign = np.sign(found.factor)
    for _ in range(ROUNDS):
        off = np.abs(found.of(values) - known)
        typical = max(1.4826 * float(np.median(off)), 1e-9 * float(np.abs(known).max()))
        weights = 1 / (1 + (off / (2 * typical)) ** 2)
        (x, dx), (y, dy) = _spread(values, weights), _spread(known, weights)
        if dx <= 0 or dy <= 0:
            return None
        factor = float(sign * dy / dx)
        found = Affine(factor, y - factor * x, _correlation(values, known, weights))
    return found


def _by_medians(values: Plane, known: Plane, sign: float) -> Affine:
    """Return a start value from medians, which outliers hardly influence."""
    (x, dx), (y, dy) = _middle(values), _middle(known)
    factor = sign * dy / dx
    return Affine(factor, y - factor * x, 0.0)


def _middle(values: Plane) -> tuple[float, float]:
    """Return the median and the median absolute deviation, or the standard deviation if the latter
    is zero.
    """
    median = float(np.median(values))
    return median, float(np.median(np.abs(values - median))) or float(values.std())


def _spread(values: Plane, weights: Plane) -> tuple[float, float]:
    mean = float(np.average(values, weights=weights))
    return mean, float(np.sqrt(np.average((values - mean) ** 2, weights=weights)))


def _correlation(x: Plane, y: Plane, weights: Plane) -> float:
    (mean_x, dx), (mean_y, dy) = _spread(x, weights), _spread(y, weights)
    together = float(np.average((x - mean_x) * (y - mean_y), weights=weights))
    return together / (dx * dy) if dx > 0 and dy > 0 else 0.0
