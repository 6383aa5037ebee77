"""Where another scene begins: a cut between shots, a view that comes back elsewhere, another size or frame rate."""

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
    """What counts as the same scene; the measures are those of `likeness`. Raises InvalidSetting out of range."""

    same_difference: float = 0.15
    """Up to this difference it is the same scene, and nothing else is looked at."""
    same_structure: float = 0.72
    """From this structure on it is the same scene ..."""
    same_moved: float = 0.83
    """... or when a quarter of the picture is found again so well."""
    same_after_gap_difference: float = 0.2
    """After frames that could not be used the tissue may have moved: up to this difference ..."""
    same_after_gap_colours: float = 0.65
    """... with so many colours in common it is still the same scene."""
    longest_doubt_frames: int = 6
    """A frame like no other waits for the next one to be like it; after so many frames that are like no other it is a cut anyway."""
    views: int = 4
    """Views of the present scene, and of earlier ones, that a view which comes back is compared with."""
    view_every: int = 15
    """One frame in so many is kept as such a view."""
    rate_ratio: float = 1.4
    """Another frame rate differs by this factor ..."""
    rate_frames: int = 15
    """... in the median of so many frames."""

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
    """What a frame is beside those before it."""

    new_scene: str | None = None
    """Why another scene begins with it: "cut", "returned" (to an earlier scene), "resized" or "frame rate"."""
    in_doubt: bool = False
    """It is like no frame before; the next one will tell whether that was a cut. Not to be trained on."""


class CutDetector:
    """Follows a stream, one call a frame: `observe` for usable frames, `skip` for the others.

    A cut is reported with the second frame of the new scene: the first is in doubt, because one odd frame that is followed by the old
    scene is none. A fixed number of small pictures is kept.
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
        """A frame came that cannot be used."""
        self._gap = True

    def observe(self, image: NDArray[np.uint8], seq: int, pts_ns: int) -> SceneVerdict:
        """What the frame with the RGB uint8 picture [H, W, 3] is; `seq` counts the frames that there were, lost ones too."""
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
        """Whether the view belongs to the present scene."""
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
    """Notices a lasting change of the time between frames; frames that were lost on the way are counted by their numbers."""

    def __init__(self, ratio: float, frames: int) -> None:
        self.ratio = ratio
        self._recent: deque[float] = deque(maxlen=frames)
        self._usual_ns: float | None = None
        self._last: tuple[int, int] | None = None

    def changed(self, seq: int, pts_ns: int) -> bool:
        """Whether the rate has become another one, with this frame."""
        if self._last is not None and seq > self._last[0] and pts_ns > self._last[1]:
            self._recent.append((pts_ns - self._last[1]) / (seq - self._last[0]))
        self._last = (seq, pts_ns)
        if len(self._recent) < (self._recent.maxlen or 0):
            return False
        now_ns = float(np.median(self._recent))
        # All of them, not only their median: an unsteady clock is no other rate.
        if self._usual_ns is None:
            self._usual_ns = now_ns
            return False
        slower = min(self._recent) > self.ratio * self._usual_ns
        faster = max(self._recent) * self.ratio < self._usual_ns
        if slower or faster:
            self._usual_ns = now_ns
            return True
        return False
