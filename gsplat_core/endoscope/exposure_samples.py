"""Small pictures whose brightness is compared, channel by channel, for the exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.median import median_of
from gsplat_core.endoscope.reduced import reduced, reduced_mask

WIDTH_PX, HEIGHT_PX = 24, 20
"""Fewer pixels than numpy gives Python's interpreter lock away for, and has to wait for it again: 500."""
AGREEMENT = 0.05
"""Logarithms of ratios that differ by no more agree."""


@dataclass(frozen=True)
class Sample:
    """A reduced picture: logarithms of its channels, and where they can be compared."""

    logs: NDArray[np.float32]
    """[pixels, 3]"""
    valid: NDArray[np.bool_]
    """[pixels, 3]"""


@dataclass(frozen=True)
class Reference:
    """An earlier picture and the logarithms of its gains."""

    sample: Sample
    log_gain: NDArray[np.float64]
    """[3]"""


def sample_of(image: NDArray[np.uint8], kept: NDArray[np.generic] | None, darkest: int, brightest: int) -> Sample:
    """Of RGB uint8 [H, W, 3]; comparable where `kept` [H, W] is not 0 and a channel lies between the two levels."""
    # Averaged from 8-bit values in floats: at this size in 8 bits a step of 1 % in a dark channel would be lost.
    small = reduced(image, 4 * WIDTH_PX, 4 * HEIGHT_PX).astype(np.float32)
    small = np.asarray(cv2.resize(small, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA), np.float32)
    valid = (small > darkest) & (small < brightest)
    if kept is not None:
        valid &= reduced_mask(kept, WIDTH_PX, HEIGHT_PX)[..., None]
    return Sample(np.log(np.maximum(small, 1.0)).reshape(-1, 3), valid.reshape(-1, 3))


def ratio(sample: Sample, reference: Sample, channel: int) -> tuple[float, float]:
    """How much brighter the sample is in a channel, as a logarithm, and the median distance of the pixels from that; infinite if too few."""
    both = sample.valid[:, channel] & reference.valid[:, channel]
    difference = (sample.logs[:, channel] - reference.logs[:, channel])[both]
    if len(difference) < len(both) // 20:
        return 0.0, math.inf
    shift = median_of(difference)
    away = np.abs(difference - shift)
    spread = median_of(away)
    # The mean of those near the median: what moved, or is a tool, lies further away on one side.
    for _ in range(2):
        near = difference[away <= max(2 * spread, 0.02)]
        shift = float(near.mean()) if len(near) else shift
        away = np.abs(difference - shift)
    return shift, spread


def share_with(sample: Sample, reference: Sample, log_gain: NDArray[np.float64]) -> float:
    """The share of the pixels whose ratios agree with these gains, [3], within 5 % in every channel that can be compared."""
    both = sample.valid & reference.valid
    agrees = np.abs(sample.logs - reference.logs - log_gain.astype(np.float32)) <= AGREEMENT
    some = both.any(axis=1)
    return float(((agrees | ~both).all(axis=1) & some).sum()) / max(1, int(some.sum()))
