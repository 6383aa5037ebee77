"""Confidence of measured depth maps.

Sensors, renderers and resizing produce edge pixels that belong to neither side, near-zero values
next to unknown depth, and wrong rows or columns along the border. Gaussians initialised there float
in front of the tissue and occlude it when they move.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ALIKE = 0.1
"""Largest relative depth difference of neighbours on one surface, as a share of the farther one."""
NEAREST = 0.1
"""Share of the median depth below which a value is noise around zero."""
STRIDE = 4
"""Subsampling of rows and columns for the median."""
PAIRS = (
    (np.s_[:, :-1], np.s_[:, 1:]),
    (np.s_[:-1, :], np.s_[1:, :]),
    (np.s_[:-1, :-1], np.s_[1:, 1:]),
    (np.s_[:-1, 1:], np.s_[1:, :-1]),
)
"""Slices that pair every pixel with four of its neighbours; the other four are covered by symmetry.
"""


def measured_confidence(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the confidence of measured depth.

    A pixel gets 0 if its depth is not finite and positive, if it is far below the median, or if
    most of its known neighbours differ from it. Other pixels get 1, including those without known
    neighbours.

    Args:
        depth: floating [H, W].

    Returns:
        float32 [H, W], 0 or 1.
    """
    known = np.isfinite(depth) & (depth > 0)
    values = np.where(known, depth, 0).astype(np.float32)
    known &= values >= NEAREST * _median(values)
    balance = np.zeros(depth.shape, np.int8)
    for one, other in PAIRS:
        here, there = values[one], values[other]
        alike = np.abs(here - there) <= ALIKE * np.maximum(here, there)
        vote = np.where(alike, np.int8(1), np.int8(-1)) * (known[one] & known[other])
        balance[one] += vote
        balance[other] += vote
    return (known & (balance >= 0)).astype(np.float32)


def _median(values: NDArray[np.float32]) -> float:
    """Return the median of the non-zero values, or 0 if there are none."""
    for some in (values[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE], values):
        if np.any(some):
            return float(np.median(some[some > 0]))
    return 0.0
