"""Scene change detection: cuts between shots, returns to an earlier scene, and changes of size or
frame rate.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.likeness import View, difference, likeness
from gsplat_core.endoscope.setting_ranges import check_settings
from gsplat_core.value_ranges import IntegerIn, NumberIn


@dataclass(frozen=True)
class CutSettings:
    """Thresholds for frames of the same scene; the measures are those of `likeness`.

    Raises:
        InvalidSetting: for a value out of its range.
    """

    same_difference: float = 0.15
    """Difference up to which two frames show the same scene without further tests."""
    same_structure: float = 0.72
    """Structure from which two frames show the same scene."""
    same_moved: float = 0.83
    """Correlation of a quarter of the picture, searched over the whole other picture, from which
    two frames show the same scene.
    """
    same_after_gap_difference: float = 0.2
    """Difference up to which frames after a gap of unusable frames may show the same scene, if
    their colours agree as well.
    """
    same_after_gap_colours: float = 0.65
    """Overlap of colours required for frames after a gap."""
    longest_doubt_frames: int = 6
    """Largest number of consecutive unmatched frames before a cut is reported. Normally a cut is
    confirmed by the next frame matching the unmatched one.
    """
    views: int = 4
    """Number of views kept of the present scene; twice as many are kept of earlier ones."""
    view_every: int = 15
    """Number of frames between two kept views."""
    rate_ratio: float = 1.4
    """Factor by which a new frame rate must differ."""
    rate_frames: int = 15
    """Number of frames over which the frame rate is observed."""

    def __post_init__(self) -> None:
        share, count = NumberIn(0.0, 1.0), IntegerIn(1, 10_000)
        check_settings(
            self,
            same_difference=NumberIn(0.0, 10.0),
            same_structure=share,
            same_moved=share,
            same_after_gap_difference=NumberIn(0.0, 10.0),
            same_after_gap_colours=share,
            longest_doubt_frames=count,
            views=IntegerIn(1, 100),
            view_every=count,
            rate_ratio=NumberIn(1.01, 100.0),
            rate_frames=IntegerIn(3, 10_000),
        )


@dataclass(frozen=True)
class SceneVerdict:
    """Classification of a frame relative to earlier ones."""

    new_scene: str | None = None
    """Reason why a new scene starts with the frame: "cut", "returned" (to an earlier scene),
    "resized" or "frame rate". None for the same scene.
    """
    in_doubt: bool = False
    """True for an unmatched frame; the next frame decides whether it was a cut. Such a frame is not
    trained on.
    """


class CutDetector:
    """Scene change detector of a stream. Call `observe` for usable frames and `skip` for others.

    A cut is reported with the second frame of the new scene, because a single odd frame is not a
    cut. A bounded number of reduced pictures is kept.
    """

    def __init__(self, settings: CutSettings | None = None) -> None:
        self.settings = settings or CutSettings()
        self._last: View | None = None
        self._shape: tuple[int, ...] = ()
        self._doubted: View | None = None
        self._doubts = 0
        self._gap = False
        self._views: deque[View] = deque(maxlen=self.settings.views)
        self._earlier: deque[View] = deque(maxlen=2 * self.settings.views)
        self._since_view = 0
        self._rate = FrameRate(self.settings.rate_ratio, self.settings.rate_frames)

    def skip(self) -> None:
        """Record an unusable frame."""
        self._gap = True

    def observe(self, image: NDArray[np.uint8], seq: int, pts_ns: int) -> SceneVerdict:
        """Classify the next frame.

        Args:
            image: RGB uint8 [H, W, 3].
            seq: frame number, including lost frames.
            pts_ns: timestamp in nanoseconds.
        """
        view = View(image)
        other_rate = self._rate.changed(seq, pts_ns)
        if self._last is None:
            self._shape = image.shape
            return self._accept(view, None)
        if image.shape != self._shape:
            self._shape = image.shape
            return self._accept(view, "resized")
        if self._related(view):
            return self._accept(view, "frame rate" if other_rate else None)
        settled = self._doubted is not None and self._same(view, self._doubted, gap=False)
        self._doubts += 1
        if settled or self._doubts > self.settings.longest_doubt_frames:
            known = any(self._same(view, earlier, gap=False) for earlier in self._earlier)
            return self._accept(view, "returned" if known else "cut")
        self._doubted = view
        return SceneVerdict(in_doubt=True)

    def _related(self, view: View) -> bool:
        """Return True if the view belongs to the present scene."""
        assert self._last is not None
        if self._same(view, self._last, self._gap):
            return True
        interrupted = self._gap or self._doubted is not None
        return interrupted and any(self._same(view, earlier, self._gap) for earlier in self._views)

    def _same(self, view: View, other: View, gap: bool) -> bool:
        settings = self.settings
        if difference(view, other) <= settings.same_difference:
            return True
        found = likeness(view, other)
        if found.structure >= settings.same_structure or found.moved >= settings.same_moved:
            return True
        near = found.difference <= settings.same_after_gap_difference
        return gap and near and found.colours >= settings.same_after_gap_colours

    def _accept(self, view: View, new_scene: str | None) -> SceneVerdict:
        self._since_view += 1
        if new_scene is not None:
            self._earlier.extend(self._views)
            if self._last is not None:
                self._earlier.append(self._last)
            self._views.clear()
        if new_scene is not None or self._since_view >= self.settings.view_every:
            self._views.append(view)
            self._since_view = 0
        self._last, self._doubted, self._doubts, self._gap = view, None, 0, False
        return SceneVerdict(new_scene)


class FrameRate:
    """Detector of lasting changes of the frame rate. Lost frames are accounted for by their
    numbers.
    """

    def __init__(self, ratio: float, frames: int) -> None:
        self.ratio = ratio
        self._recent: deque[float] = deque(maxlen=frames)
        self._usual_ns: float | None = None
        self._last: tuple[int, int] | None = None

    def changed(self, seq: int, pts_ns: int) -> bool:
        """Return True if the frame rate changed with this frame."""
        if self._last is not None and seq > self._last[0] and pts_ns > self._last[1]:
            self._recent.append((pts_ns - self._last[1]) / (seq - self._last[0]))
        self._last = (seq, pts_ns)
        if len(self._recent) < (self._recent.maxlen or 0):
            return False
        now_ns = float(np.median(self._recent))
        # Require all intervals, not only their median: an unsteady clock is no other rate.
        if self._usual_ns is None:
            self._usual_ns = now_ns
            return False
        slower = min(self._recent) > self.ratio * self._usual_ns
        faster = max(self._recent) * self.ratio < self._usual_ns
        if slower or faster:
            self._usual_ns = now_ns
            return True
        return False
