"""Which pixels of a measured depth map are to be believed.

Sensors, renderers and whoever resizes their pictures leave pixels at edges that lie on neither side, some near nothing beside what is unknown, and a row or
column of something else along the border. A scene that starts there has Gaussians that float before the tissue, and hide it when they are carried along.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ALIKE = 0.1
"""Two neighbours lie on one surface where they differ by less than this share of the farther one."""
NEAREST = 0.1
"""What is nearer than this share of the median depth is not tissue but noise about zero."""
STRIDE = 4
"""The median is that of each fourth pixel of each fourth row."""
PAIRS = (
    (np.s_[:, :-1], np.s_[:, 1:]),
    (np.s_[:-1, :], np.s_[1:, :]),
    (np.s_[:-1, :-1], np.s_[1:, 1:]),
    (np.s_[:-1, 1:], np.s_[1:, :-1]),
)
"""Every pixel and four of its neighbours; the other four see it as theirs."""


def measured_confidence(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """The confidence [H, W] of measured depth [H, W]: 0 where it is not a positive finite number, where it is far too near, and where more of the
    neighbours with such depth differ from it than are like it; 1 elsewhere. A pixel without neighbours is believed."""
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
    """Of what is not 0; 0 where there is nothing."""
    for some in (values[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE], values):
        if np.any(some):
            return float(np.median(some[some > 0]))
    return 0.0
