"""Exposure and white balance of each frame relative to the first frames of the stream.

A gain change multiplies all pixels of a channel by one factor, which is the ratio to the same tissue in an earlier
picture where neither is dark or clipped. Pictures of the last seconds are kept as references with their gains. A
frame is compared with the references that resemble it most, so heartbeat and tools need no tracking. Changes that
references do not reveal, such as a slow approach or bleeding, are left to the model.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.reduced import median_of, reduced, reduced_mask

WIDTH_PX, HEIGHT_PX = 24, 20
"""Size of the reduced pictures. They have fewer than 500 pixels, because numpy releases the
interpreter lock for larger arrays and must wait to reacquire it.
"""
AGREEMENT = 0.05
"""Largest difference of two log brightness ratios that count as equal."""


@dataclass(frozen=True)
class Sample:
    """Logarithms of a reduced picture, with a mask of the comparable values."""

    logs: NDArray[np.float32]
    """Logarithms of the pixels' values, per colour channel [pixels, 3]."""
    valid: NDArray[np.bool_]
    """True for tissue values that are neither too dark nor too bright to be compared, [pixels, 3]."""


@dataclass(frozen=True)
class Reference:
    """Reduced earlier picture with the logarithms of its gains."""

    sample: Sample
    log_gain: NDArray[np.float64]
    """Logarithms of the picture's channel gains, [3]."""


def sample_of(image: NDArray[np.uint8], kept: NDArray[np.generic] | None) -> Sample:
    """Sample a picture's values at a small resolution.

    Args:
        image: RGB uint8 [H, W, 3].
        kept: [H, W], 0 outside the tissue, or None.
    """
    # Average in floats in the last reduction. In 8 bits a change of 1 % in a dark channel would be lost.
    small = reduced(image, 4 * WIDTH_PX, 4 * HEIGHT_PX).astype(np.float32)
    small = np.asarray(cv2.resize(small, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA), np.float32)
    valid = (small > DARKEST_LEVEL) & (small < BRIGHTEST_LEVEL)
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
    # Average only values near the median, because moving parts and tools deviate to one side.
    for _ in range(2):
        near = difference[away <= max(2 * spread, 0.02)]
        shift = float(near.mean()) if len(near) else shift
        away = np.abs(difference - shift)
    return shift, spread


def share_with(sample: Sample, reference: Sample, log_gain: NDArray[np.float64]) -> float:
    """Return the share of pixels whose ratios agree with log gains [3] within `AGREEMENT` in every comparable channel."""
    both = sample.valid & reference.valid
    agrees = np.abs(sample.logs - reference.logs - log_gain.astype(np.float32)) <= AGREEMENT
    some = both.any(axis=1)
    return float(((agrees | ~both).all(axis=1) & some).sum()) / max(1, int(some.sum()))


Gains = tuple[float, float, float]
UNCHANGED: Gains = (1.0, 1.0, 1.0)


DEAD_ZONE = 0.08
"""Difference between the measured and the held log exposure gain up to which the gain stays held, in the comparison
with the previous frame.
"""
DRIFT_ZONE = 0.1
"""Difference between the measured and the held log exposure gain up to which the gain stays held, in the comparison
with earlier pictures that detects slow changes. Larger than `DEAD_ZONE`, because the tissue has moved since those
pictures.
"""
MORE_PIXELS = 1.5
"""Ratio of the pixels that agree with a gain change to those that agree with no change, from which the change is
accepted.
"""
ANCHOR_ZONE = 0.15
"""Largest deviation of a settled gain from the comparison with the scene's first frame, if that is possible."""
RELEASE_ZONE = 0.04
"""Distance from 1 within which a settled gain is set to exactly 1."""
SETTLED_CHANGE = 0.02
"""Change from frame to frame below which a gain counts as settled."""
SETTLED_FRAMES = 6
"""Number of settled frames after which a changing exposure gain is held constant again."""
MOST_REFERENCES = 12
"""Largest number of reference pictures kept."""
REFERENCE_EVERY = 4
"""Number of frames between references; 12 references every 4 frames cover 1.6 s at 30 frames/s."""
YOUNG_REFERENCES = 4
"""Number of newest references that are not used yet, so that they contain no part of a slow change."""
LEAST_CLEAR_JUMP = 1.5
"""Smallest ratio of a sudden change to the dissimilarity from the previous frame."""
LEAST_CLEAR_DRIFT = 1.0
"""Smallest ratio of a slow change to the dissimilarity from the references."""
MOST_UNLIKE = 0.25
"""Median difference from every reference, after removing the gain, above which a frame's exposure is not measured."""
LARGEST_GAIN = 8.0
"""Largest exposure gain; the smallest one is its inverse."""
FORGET_S = 300.0
"""Time constant in seconds with which a held gain returns to 1, slower than the model learns,
so that errors do not accumulate over days.
"""
DARKEST_LEVEL = 14
"""Level below which a channel is not compared because of noise and black offset."""
BRIGHTEST_LEVEL = 225
"""Level above which a channel is not compared because of clipping."""


class ExposureEstimator:
    """Gain estimator of a stream; call it for each frame in order.

    While the gain is held, sudden changes are detected against the previous frame and slow ones against older
    references. While it changes, the previous frame and the references are averaged, weighted by similarity. A bounded
    number of reduced pictures is kept. Without exposure changes the gains are exactly (1, 1, 1).
    """

    def __init__(self) -> None:
        self.following = False
        """True while the exposure is changing."""
        self._anchor: Reference | None = None
        """First frame of the scene."""
        self._references: deque[Reference] = deque(maxlen=MOST_REFERENCES)
        self._young: deque[Reference] = deque(maxlen=YOUNG_REFERENCES)
        self._previous: Reference | None = None
        self._log_gain = np.zeros(3)
        self._steady = 0
        self._since_reference = 0
        self._last_pts_ns: int | None = None

    @property
    def gains(self) -> Gains:
        """Gains of the last frame: red, green, blue."""
        red, green, blue = (float(gain) for gain in np.exp(self._log_gain))
        return red, green, blue

    def start_scene(self) -> None:
        """Start another scene, whose first frame defines the colours."""
        self._references.clear()
        self._young.clear()
        self._previous, self._last_pts_ns = None, None
        self._log_gain, self.following = np.zeros(3), False

    def observe(self, image: NDArray[np.uint8], kept: NDArray[np.generic] | None, pts_ns: int) -> Gains:
        """Estimate a frame's exposure gains relative to the scene's first frame.

        Args:
            image: RGB uint8 [H, W, 3].
            kept: [H, W], 0 outside the tissue, or None.
            pts_ns: timestamp in nanoseconds.
        """
        sample = sample_of(image, kept)
        if self._previous is None:
            self._anchor = Reference(sample, self._log_gain)
            self._references.append(self._anchor)
        elif self.following:
            self._follow(sample)
        else:
            self._hold(sample, pts_ns)
        self._previous = Reference(sample, self._log_gain)
        self._last_pts_ns = pts_ns
        return self.gains

    def _hold(self, sample: Sample, pts_ns: int) -> None:
        assert self._previous is not None
        self._since_reference += 1
        due = self._since_reference >= REFERENCE_EVERY
        if self._changed(sample, [self._previous], DEAD_ZONE, LEAST_CLEAR_JUMP):
            self._references.extend(self._young)
        # Slow drift of the gain is compared with older frames only every `REFERENCE_EVERY` frames.
        elif not due or not self._changed(sample, self._references, DRIFT_ZONE, LEAST_CLEAR_DRIFT):
            self._forget(pts_ns)
            if due:
                self._since_reference = 0
                if len(self._young) == self._young.maxlen:
                    self._references.append(self._young.popleft())
                self._young.append(Reference(sample, self._log_gain))
            return
        self._young.clear()
        self.following, self._steady = True, 0

    def _changed(self, sample: Sample, references: Iterable[Reference], zone: float, clear: float) -> bool:
        """Return True if the references show a clearly different gain. In that case the gain is set to it."""
        found = self._compare(sample, references)
        if found is None:
            return False
        measured, spread, best = found
        change = np.abs(measured - self._log_gain).max()
        if change <= max(zone, clear * spread):
            return False
        # Compare the numbers of pixels that agree with the change and with no change. A tool that covers half of the
        # picture shifts the mean, but the visible tissue still agrees with no change.
        same = share_with(sample, best.sample, self._log_gain - best.log_gain)
        if share_with(sample, best.sample, measured - best.log_gain) < MORE_PIXELS * same:
            return False
        self._set(measured)
        return True

    def _follow(self, sample: Sample) -> None:
        assert self._previous is not None
        found = self._compare(sample, [self._previous, *self._references])
        if found is None:
            return
        before = self._log_gain
        self._set(found[0])
        still = np.abs(self._log_gain - before).max() < SETTLED_CHANGE
        self._steady = self._steady + 1 if still else 0
        self._since_reference += 1
        if self._since_reference >= REFERENCE_EVERY:
            self._since_reference = 0
            self._references.append(Reference(sample, self._log_gain))
        if self._steady >= SETTLED_FRAMES:
            self.following = False
            self._settle(sample)

    def _settle(self, sample: Sample) -> None:
        """Limit the deviation from the scene's first frame, so that errors of many changes do not accumulate."""
        assert self._anchor is not None
        found = self._compare(sample, [self._anchor])
        if found is not None:
            self._set(np.clip(self._log_gain, found[0] - ANCHOR_ZONE, found[0] + ANCHOR_ZONE))
        self._release()

    def _compare(
        self, sample: Sample, references: Iterable[Reference]
    ) -> tuple[NDArray[np.float64], float, Reference] | None:
        """Return log gains by the most similar references, the dissimilarity of the best one, and
        that reference; None if no reference is similar.
        """
        alike = []
        for reference in references:
            shift, spread = ratio(sample, reference.sample, 1)
            if spread <= MOST_UNLIKE:
                alike.append((spread, reference, shift))
        if not alike:
            return None
        alike.sort(key=lambda entry: entry[0])
        total, weights = np.zeros(3), np.zeros(3)
        for spread, reference, green in alike[:3]:
            for channel in range(3):
                shift, own = (green, spread) if channel == 1 else ratio(sample, reference.sample, channel)
                weight = 0.0 if own > MOST_UNLIKE else 1 / (own + 0.01) ** 2
                total[channel] += weight * (shift + reference.log_gain[channel])
                weights[channel] += weight
        known = weights > 0
        if not known.any():
            return None
        measured = total / np.maximum(weights, 1e-9)
        # Change a channel that is clipped or dark everywhere like the mean of the other channels.
        others = float((measured - self._log_gain)[known].mean())
        return np.where(known, measured, self._log_gain + others), alike[0][0], alike[0][1]

    def _forget(self, pts_ns: int) -> None:
        if self._last_pts_ns is not None and self._log_gain.any():
            passed_s = min(max((pts_ns - self._last_pts_ns) * 1e-9, 0.0), 1.0)
            self._log_gain = self._log_gain * math.exp(-passed_s / FORGET_S)
            self._release()

    def _release(self) -> None:
        if np.abs(self._log_gain).max() < RELEASE_ZONE:
            self._log_gain = np.zeros(3)

    def _set(self, log_gain: NDArray[np.float64]) -> None:
        most = math.log(LARGEST_GAIN)
        self._log_gain = np.clip(log_gain, -most, most)
