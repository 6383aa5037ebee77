"""Depth that is known up to a factor and a summand, as a network says it: both found by other depth of the same picture, or assumed.

All of it works on values that are the depth itself or its inverse; the answer is of the same kind.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float64]

MOST_SPAN = 5.0
"""Where nothing says what zero means, the far end of a picture is taken to be at most so many times as far away as its near end."""
ENDS = (2.0, 98.0)
"""Percentiles that count as the ends of a picture; what is beyond may be anything."""
ROUNDS = 10
LEAST_VALUES = 64
CONSTANT = 1e-4
"""Spread over size below which values say nothing but one distance."""


class Affine(NamedTuple):
    """`factor` · values + `summand`."""

    factor: float
    summand: float
    alike: float
    """-1 to 1: correlation of both sides where they agree best; with a negative one the factor is negative, too."""

    def of(self, values: Plane) -> Plane:
        """The values, brought to the other side."""
        return self.factor * values + self.summand


def is_constant(values: Plane) -> bool:
    """Whether [N] say no more than one distance."""
    low, high = np.percentile(values, ENDS)
    return bool(high - low <= CONSTANT * max(abs(low), abs(high), 1e-30))


def with_assumed_zero(values: Plane) -> Affine:
    """What to add to [N], of which no other is known, so that they span no more than `MOST_SPAN`; nothing where they do not."""
    low, high = np.percentile(values, ENDS)
    missing = (high - MOST_SPAN * low) / (MOST_SPAN - 1)
    return Affine(1.0, max(0.0, float(missing)), 1.0)


def fitted(values: Plane, known: Plane) -> Affine | None:
    """What brings [N] to `known` [N], by most of them; None where they are too few or say one distance.

    Both sides have errors, so their spreads are made equal (reduced major axis). Least squares would lose a little of the relief each time, and
    depth that is fitted to the depth before it, frame after frame, would end flat. Iteratively reweighted by Cauchy's weights.
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
    """Where to start from; values that do not belong there hardly move it."""
    (x, dx), (y, dy) = _middle(values), _middle(known)
    factor = sign * dy / dx
    return Affine(factor, y - factor * x, 0.0)


def _middle(values: Plane) -> tuple[float, float]:
    """The median, and how far values typically are from it."""
    median = float(np.median(values))
    return median, float(np.median(np.abs(values - median))) or float(values.std())


def _spread(values: Plane, weights: Plane) -> tuple[float, float]:
    mean = float(np.average(values, weights=weights))
    return mean, float(np.sqrt(np.average((values - mean) ** 2, weights=weights)))


def _correlation(x: Plane, y: Plane, weights: Plane) -> float:
    (mean_x, dx), (mean_y, dy) = _spread(x, weights), _spread(y, weights)
    together = float(np.average((x - mean_x) * (y - mean_y), weights=weights))
    return together / (dx * dy) if dx > 0 and dy > 0 else 0.0
