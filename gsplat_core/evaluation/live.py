"""The live protocol: what was on the screen when frame i+1 arrived, against frame i.

The picture of frame i has the time until the next frame comes. What is on the screen at that moment is the last picture that was shown before
it: of frame i when it was in time, an older one when it was late or was never made. Pictures that were shown and replaced before then are not
scored, and a viewer of a source that stopped sees what was shown last: nothing is scored until another frame comes.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.ages import AgeHistogram, Ages
from gsplat_core.evaluation.scores import Record, Score, ScoreSums, measures, why_left_out
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import FrameQuality, frame_quality, psnr_tissue_db

MOST_BEHIND = 8
"""Lateness is counted up to so many frames; what is later counts as this many."""
NOTHING_SHOWN, NOT_KEPT = "nothing shown yet", "picture not kept"
_MAX_STATES = 16
_NS_PER_MS = 1e6


@dataclass(frozen=True)
class Shown:
    """One picture that was put on the screen."""

    seq: int
    """Number of the frame whose content it shows."""
    arrived_ns: int
    """When that frame had come in."""
    shown_ns: int
    """When the picture was on the screen; both by one clock."""
    image: NDArray[np.uint8] | None = None
    """RGB [H, W, 3]; None where the picture was not kept."""
    psnr_tissue_db: float | None = None
    """What it scored against its own frame, where that was measured when it was shown."""
    state: str = "live"
    """What was written on it: `live`, `stale`, `frozen`, `source lost`."""


@dataclass(frozen=True)
class Live:
    """How good what a viewer saw was, and how old."""

    score: Score
    age_when_shown: Ages | None
    """From a frame's arrival to the moment when its picture was shown."""
    age_on_screen: Ages | None
    """How old what was on the screen was when the next frame arrived: at least the time between two frames."""
    in_time: int
    """Frames whose own picture was on the screen when the next one came."""
    behind: Mapping[int, int]
    """How many frames older than the newest one the picture on the screen was, and how often; `MOST_BEHIND` stands for all that is more."""
    estimated: int
    """Frames whose late picture was not kept: scored by the raw frame that it shows, or by the picture's own figure where that is lower."""
    states: Mapping[str, int]
    """How many pictures were shown in each state."""


def evaluate_live(frames: Iterable[Frame], shown: Iterable[Shown], *, record: Record | None = None) -> Live:
    """Score what was on the screen; everything is read once.

    Args:
        frames: every frame that arrived, in order, with `arrived_ns`; also those that were dropped and never shown. The last one is not
            scored: nobody knows when the next one would have come.
        shown: the pictures in the order in which they were shown.
        record: given each scored frame's figures.

    Raises InvalidInput when a frame has no time of arrival, or when times run backwards.
    """
    screen = _Screen(shown)
    sums = _Sums(record)
    raw: deque[Frame] = deque(maxlen=MOST_BEHIND + 1)
    for frame, following in pairwise(_in_order(frames)):
        raw.append(frame)
        assert following.arrived_ns is not None
        picture = screen.at(following.arrived_ns)
        reason = why_left_out(frame)
        if reason is None and picture is None:
            reason = NOTHING_SHOWN
        if reason is not None or picture is None:
            sums.score.leave_out(str(reason))
            continue
        sums.add(frame, picture, following.arrived_ns, raw)
    screen.rest()
    return Live(
        score=sums.score.score,
        age_when_shown=screen.ages.ages(),
        age_on_screen=sums.ages.ages(),
        in_time=sums.behind[0],
        behind=dict(sorted(sums.behind.items())),
        estimated=sums.estimated,
        states=dict(sorted(screen.states.items())),
    )


class _Screen:
    """What is to be seen at a moment. Takes the pictures as time goes on."""

    def __init__(self, shown: Iterable[Shown]) -> None:
        self._coming = iter(shown)
        self._next: Shown | None = next(self._coming, None)
        self._now: Shown | None = None
        self.ages = AgeHistogram()
        self.states: Counter[str] = Counter()

    def at(self, moment_ns: int) -> Shown | None:
        """The last picture shown before the moment."""
        while self._next is not None and self._next.shown_ns < moment_ns:
            self._take()
        return self._now

    def rest(self) -> None:
        """Count the pictures that were shown after the last frame had come."""
        while self._next is not None:
            self._take()

    def _take(self) -> None:
        picture, before = self._next, self._now
        assert picture is not None
        if before is not None and picture.shown_ns < before.shown_ns:
            raise InvalidInput(
                f"the picture of frame {picture.seq} was shown before that of frame {before.seq}, which came first; give them in order"
            )
        self.ages.add((picture.shown_ns - picture.arrived_ns) / _NS_PER_MS)
        known = picture.state in self.states or len(self.states) < _MAX_STATES
        self.states[picture.state if known else "other"] += 1
        self._now, self._next = picture, next(self._coming, None)


class _Sums:
    """What the frames scored so far come to."""

    def __init__(self, record: Record | None) -> None:
        self.score = ScoreSums()
        self.ages = AgeHistogram()
        self.behind: Counter[int] = Counter()
        self.estimated = 0
        self._record = record

    def add(self, frame: Frame, picture: Shown, moment_ns: int, raw: Iterable[Frame]) -> None:
        """Score what is on the screen at a moment. raw: the newest frames that have come."""
        age_ms = (moment_ns - picture.arrived_ns) / _NS_PER_MS
        late = min(max(frame.seq - picture.seq, 0), MOST_BEHIND)
        self.ages.add(age_ms)
        self.behind[late] += 1
        quality = self._quality(frame, picture, raw)
        if quality is None:
            self.score.leave_out(NOT_KEPT)
            return
        self.score.take(quality)
        if self._record is not None:
            own = {"seq": frame.seq, "time_s": frame.time_s, "trained": True, "model_version": 0}
            self._record({**own, **measures(quality), "age_ms": age_ms, "behind": frame.seq - picture.seq})

    def _quality(self, frame: Frame, picture: Shown, raw: Iterable[Frame]) -> FrameQuality | None:
        if picture.image is not None:
            if picture.image.shape == frame.image.shape:
                return frame_quality(frame.seq, picture.image, frame.image, frame.mask)
            return None
        own_db = math.nan if picture.psnr_tissue_db is None else picture.psnr_tissue_db
        if picture.seq == frame.seq:
            return None if math.isnan(own_db) else FrameQuality(frame.seq, own_db, math.nan, math.nan)
        for old in raw:
            if old.seq == picture.seq and old.image.shape == frame.image.shape:
                self.estimated += 1
                held_db = psnr_tissue_db(old.image, frame.image, frame.mask)
                return FrameQuality(
                    frame.seq, min(held_db, own_db) if own_db == own_db else held_db, math.nan, math.nan
                )
        return None


def _in_order(frames: Iterable[Frame]) -> Iterator[Frame]:
    before: Frame | None = None
    for frame in frames:
        if frame.arrived_ns is None:
            raise InvalidInput(f"frame {frame.seq} has no time of arrival; the live protocol needs one for every frame")
        if before is not None and before.arrived_ns is not None and frame.arrived_ns < before.arrived_ns:
            raise InvalidInput(f"frame {frame.seq} arrived before frame {before.seq}; give the frames in order")
        yield frame
        before = frame
