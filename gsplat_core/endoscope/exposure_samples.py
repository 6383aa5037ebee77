"""Reduced pictures for comparing brightness per channel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.median import median_of
from gsplat_core.endoscope.reduced import reduced, reduced_mask

WIDTH_PX, HEIGHT_PX = 24, 20
"""Size of the reduced pictures. They have fewer than 500 pixels, because numpy releases the
interpreter lock for larger arrays and must wait to reacquire it.
"""
AGREEMENT = 0.05
"""Largest difference of log ratios that agree."""


@dataclass(frozen=True)
class Sample:
    """Reduced picture as log levels with validity."""

    logs: NDArray[np.float32]
    """Log levels, [pixels, 3]."""
    valid: NDArray[np.bool_]
    """Comparable values, [pixels, 3]."""


@dataclass(frozen=True)
class Reference:
    """Earlier picture with its log gains."""

    sample: Sample
    log_gain: NDArray[np.float64]
    """Log gains, [3]."""


def sample_of(image: NDArray[np.uint8], kept: NDArray[np.generic] | None, darkest: int, brightest: int) -> Sample:
    """Reduce a picture.

    Args:
        image: RGB uint8 [H, W, 3].
        kept: [H, W], 0 outside the tissue, or None.
        darkest: level that valid channels exceed.
        brightest: level that valid channels stay below.
    """
    # The last averaging is in floats: in 8 bits a change of 1 % in a dark channel would be lost.
    small = reduced(image, 4 * WIDTH_PX, 4 * HEIGHT_PX).astype(np.float32)
    small = np.asarray(cv2.resize(small, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA), np.float32)
    valid = (small > darkest) & (small < brightest)
    if kept is not None:
        valid &= reduced_mask(kept, WIDTH_PX, HEIGHT_PX)[..., None]
    return Sample(np.log(np.maximum(small, 1.0)).reshape(-1, 3), valid.reshape(-1, 3))


def ratio(sample: Sample, reference: Sample, channel: int) -> tuple[float, float]:
    """Return the log ratio of a channel to the reference, and the median deviation of the pixels
    from it; infinite with too few pixels.
    """
    both = sample.valid[:, channel] & reference.valid[:, channel]
    difference = (sample.logs[:, channel] - reference.logs[:, channel])[both]
    if len(difference) < len(both) // 20:
        return 0.0, math.inf
    shift = median_of(difference)
    away = np.abs(difference - shift)
    spread = median_of(away)
    # Average values near the median. Moving parts and tools deviate to one side.
    for _ in range(2):
        near = difference[away <= max(2 * spread, 0.02)]
        shift = float(near.mean()) if len(near) else shift
        away = np.abs(difference - shift)
    return shift, spread


def share_with(sample: Sample, reference: Sample, log_gain: NDArray[np.float64]) -> float:
    """Return the share of pixels whose ratios agree with log gains [3] within `AGREEMENT` in every
    comparable channel.
    """
    both = sample.valid & reference.valid
    agrees = np.abs(sample.logs - reference.logs - log_gain.astype(np.float32)) <= AGREEMENT
    some = both.any(axis=1)
    return float(((agrees | ~both).all(axis=1) & some).sum()) / max(1, int(some.sum()))
