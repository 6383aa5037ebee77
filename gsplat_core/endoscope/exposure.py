"""Exposure and white balance of each frame, beside those of the stream's first frames.

A camera that changes its gain multiplies every pixel of a channel by one number, and the same tissue in an earlier picture tells which: the
ratio of the two, where neither is dark or clipped. Pictures of the last seconds are kept as references, each with its gain, and the frame is
compared with those that it resembles most, so that neither heartbeat nor a tool needs to be followed. What the references do not show as
a change (a scope that comes slowly closer, bleeding) is left to the model, which learns it anyway.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.exposure_samples import Reference, Sample, ratio, sample_of, share_with
from gsplat_core.endoscope.setting_ranges import check_settings
from gsplat_core.value_ranges import IntegerIn, NumberIn

Gains = tuple[float, float, float]
UNCHANGED: Gains = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class ExposureSettings:
    """When a change counts as one. Differences are natural logarithms of ratios: 0.08 is 8 %. Raises InvalidSetting out of range."""

    dead_zone: float = 0.08
    """A difference from the present gain up to here is ignored while the gain is held."""
    drift_zone: float = 0.1
    """The same for a slower change, which shows against older references: the tissue has moved since."""
    more_pixels: float = 1.5
    """So many times as many pixels must agree with a change as with none."""
    anchor_zone: float = 0.15
    """A gain that has settled is at most this far from what the scene's first frames say, where they can still be compared."""
    release: float = 0.04
    """A gain that has settled within this of 1 is exactly 1 again."""
    settled_change: float = 0.02
    """The gain is held again when it changes by less than this from frame to frame ..."""
    settled_frames: int = 6
    """... for so many frames."""
    references: int = 12
    """Pictures that frames are compared with."""
    reference_every: int = 4
    """One frame in so many becomes a reference; 12 of 4 are 1.6 s at 30 frames/s."""
    young_references: int = 4
    """So many of the newest references wait until a slow change would have shown."""
    least_clear_jump: float = 1.5
    """A jump is at least this many times as large as the frame is unlike the one before ..."""
    least_clear_drift: float = 1.0
    """... and a slower change this many times as large as it is unlike the references."""
    most_unlike: float = 0.25
    """A frame that differs from every reference by more than this (median, after its gain is taken out) says nothing about the exposure."""
    largest_gain: float = 8.0
    """Gains stay within this and its inverse."""
    forget_s: float = 300.0
    """A held gain returns to 1 with this time constant, slower than the model learns: errors of single changes do not add up over days."""
    darkest: int = 14
    """Channel values below this are not compared: noise and the offset of black."""
    brightest: int = 225
    """Channel values above this are not compared: clipped, or partly so."""

    def __post_init__(self) -> None:
        share = NumberIn(1e-3, 1.0)
        check_settings(
            self,
            dead_zone=share,
            drift_zone=share,
            more_pixels=NumberIn(0.0, 100.0),
            anchor_zone=share,
            release=NumberIn(0.0, 1.0),
            settled_change=share,
            settled_frames=IntegerIn(1, 1000),
            references=IntegerIn(1, 100),
            reference_every=IntegerIn(1, 1000),
            young_references=IntegerIn(1, 100),
            least_clear_jump=NumberIn(0.0, 100.0),
            least_clear_drift=NumberIn(0.0, 100.0),
            most_unlike=share,
            largest_gain=NumberIn(1.0, 100.0),
            forget_s=NumberIn(1.0, 1e6),
            darkest=IntegerIn(1, 100),
            brightest=IntegerIn(101, 255),
        )


class ExposureEstimator:
    """Follows the gains of a stream; one call a frame, in order.

    While the gain is held, a jump shows against the frame before and a slower change against older references;
    the youngest may have part of the change in them. While it changes, the frame before and the references are weighed by
    how alike they are. A fixed number of small pictures is kept. Without a change of exposure the gains are exactly (1, 1, 1).
    """

    def __init__(self, settings: ExposureSettings | None = None) -> None:
        self.settings = settings or ExposureSettings()
        self.following = False
        """Whether the exposure is changing now."""
        self._anchor: Reference | None = None
        """The scene's first frame."""
        self._references: deque[Reference] = deque(maxlen=self.settings.references)
        self._young: deque[Reference] = deque(maxlen=self.settings.young_references)
        self._previous: Reference | None = None
        self._log_gain = np.zeros(3)
        self._steady = 0
        self._since_reference = 0
        self._last_pts_ns: int | None = None

    @property
    def gains(self) -> Gains:
        """Those of the last frame: red, green, blue."""
        red, green, blue = (float(gain) for gain in np.exp(self._log_gain))
        return red, green, blue

    def start_scene(self) -> None:
        """Another scene begins: the next frame's colours are its own."""
        self._references.clear()
        self._young.clear()
        self._previous, self._last_pts_ns = None, None
        self._log_gain, self.following = np.zeros(3), False

    def observe(self, image: NDArray[np.uint8], kept: NDArray[np.generic] | None, pts_ns: int) -> Gains:
        """Gains of the frame `image`, RGB uint8 [H, W, 3]; `kept` [H, W] is 0 where it is not tissue, and `pts_ns` its time."""
        sample = sample_of(image, kept, self.settings.darkest, self.settings.brightest)
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
        settings = self.settings
        self._since_reference += 1
        due = self._since_reference >= settings.reference_every
        if self._changed(sample, [self._previous], settings.dead_zone, settings.least_clear_jump):
            self._references.extend(self._young)
        # What is slow need not be looked for in every frame.
        elif not due or not self._changed(sample, self._references, settings.drift_zone, settings.least_clear_drift):
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
        """Whether the references show another gain than the present one, clearly beside how unlike they are; takes it on if so."""
        found = self._compare(sample, references)
        if found is None:
            return False
        measured, spread, best = found
        change = np.abs(measured - self._log_gain).max()
        if change <= max(zone, clear * spread):
            return False
        # A tool that covers half of the picture moves the mean, and leaves tissue beside it as it was.
        same = share_with(sample, best.sample, self._log_gain - best.log_gain)
        if share_with(sample, best.sample, measured - best.log_gain) < self.settings.more_pixels * same:
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
        still = np.abs(self._log_gain - before).max() < self.settings.settled_change
        self._steady = self._steady + 1 if still else 0
        self._since_reference += 1
        if self._since_reference >= self.settings.reference_every:
            self._since_reference = 0
            self._references.append(Reference(sample, self._log_gain))
        if self._steady >= self.settings.settled_frames:
            self.following = False
            self._settle(sample)

    def _settle(self, sample: Sample) -> None:
        """Changes that were too small to follow, and errors of those that were not, must not add up."""
        assert self._anchor is not None
        found = self._compare(sample, [self._anchor])
        if found is not None:
            zone = self.settings.anchor_zone
            self._set(np.clip(self._log_gain, found[0] - zone, found[0] + zone))
        self._release()

    def _compare(
        self, sample: Sample, references: Iterable[Reference]
    ) -> tuple[NDArray[np.float64], float, Reference] | None:
        """Logarithms of the gains by the references that look most like the frame, how unlike the best is, and that one.

        None where no reference can tell.
        """
        alike = []
        for reference in references:
            shift, spread = ratio(sample, reference.sample, 1)
            if spread <= self.settings.most_unlike:
                alike.append((spread, reference, shift))
        if not alike:
            return None
        alike.sort(key=lambda entry: entry[0])
        total, weights = np.zeros(3), np.zeros(3)
        for spread, reference, green in alike[:3]:
            for channel in range(3):
                shift, own = (green, spread) if channel == 1 else ratio(sample, reference.sample, channel)
                weight = 0.0 if own > self.settings.most_unlike else 1 / (own + 0.01) ** 2
                total[channel] += weight * (shift + reference.log_gain[channel])
                weights[channel] += weight
        known = weights > 0
        if not known.any():
            return None
        measured = total / np.maximum(weights, 1e-9)
        # A channel that is clipped or dark throughout changes as the others do.
        others = float((measured - self._log_gain)[known].mean())
        return np.where(known, measured, self._log_gain + others), alike[0][0], alike[0][1]

    def _forget(self, pts_ns: int) -> None:
        if self._last_pts_ns is not None and self._log_gain.any():
            passed_s = min(max((pts_ns - self._last_pts_ns) * 1e-9, 0.0), 1.0)
            self._log_gain = self._log_gain * math.exp(-passed_s / self.settings.forget_s)
            self._release()

    def _release(self) -> None:
        if np.abs(self._log_gain).max() < self.settings.release:
            self._log_gain = np.zeros(3)

    def _set(self, log_gain: NDArray[np.float64]) -> None:
        most = math.log(self.settings.largest_gain)
        self._log_gain = np.clip(log_gain, -most, most)
