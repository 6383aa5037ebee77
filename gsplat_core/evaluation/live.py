"""Scores of a live run: the picture on the screen when frame i+1 arrives, against frame i.

The picture on the screen is the last one displayed before that moment. It shows frame i if frame i was processed in
time, otherwise an older frame. Pictures that were replaced before that moment are not scored. Nothing is scored while a
stopped source sends no frames.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from gsplat_core.evaluation.baselines import BaselineScore
from gsplat_core.evaluation.scores import Record, Score, ScoreSums, finite, measures
from gsplat_core.training.metrics import SETTLING_S, FrameQuality, ScoredMean

_FINEST_MS = 1e-3
_RATIO = 1.01
_BUCKETS = 2600
"""Number of logarithmic buckets; covers ages from one microsecond to two days."""


@dataclass(frozen=True)
class Ages:
    """Distribution of picture ages in milliseconds.

    Percentiles are at most 1 % too high; `max_ms` is exact.
    """

    count: int
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class AgeHistogram:
    """Histogram of ages in logarithmic buckets of 1 %."""

    def __init__(self) -> None:
        self._counts = [0] * _BUCKETS
        self._max_ms = 0.0

    def add(self, age_ms: float) -> None:
        """Add an age in milliseconds; ages below one microsecond count as one microsecond."""
        self._max_ms = max(self._max_ms, age_ms)
        place = math.ceil(math.log(max(age_ms, _FINEST_MS) / _FINEST_MS) / math.log(_RATIO) - 1e-9)
        self._counts[min(place, _BUCKETS - 1)] += 1

    def ages(self) -> Ages | None:
        """Distribution of the ages added so far; None without any age."""
        count = sum(self._counts)
        if not count:
            return None
        p50_ms, p95_ms, p99_ms = (self._quantile(share, count) for share in (0.50, 0.95, 0.99))
        return Ages(count, p50_ms, p95_ms, p99_ms, self._max_ms)

    def _quantile(self, share: float, count: int) -> float:
        """Return the age that `share` of all ages do not exceed."""
        reached = 0
        for place, here in enumerate(self._counts):
            reached += here
            if reached >= share * count - 1e-9 * count:
                return min(_FINEST_MS * _RATIO**place, self._max_ms)
        return self._max_ms


MOST_BEHIND = 8
"""Largest lateness in frames with its own counter. Later pictures are counted with it."""
NOTHING_SHOWN = "nothing shown yet"
_MAX_STATES = 16


@dataclass(frozen=True)
class Live:
    """Image quality and latency of the pictures that a viewer saw."""

    score: Score
    settled: Score
    """Score without the start-up time `SETTLING_S`."""
    previous: BaselineScore
    """Baseline for `score`: the previous raw frame, over the same frames and pixels."""
    settled_previous: BaselineScore
    """Baseline for `settled`: the previous raw frame, over the same frames and pixels."""
    age_when_shown: Ages | None
    """Time from a frame's arrival until its picture is displayed; None without a picture."""
    age_on_screen: Ages | None
    """Age of the displayed picture at the arrival of the next frame, at least one frame interval; None without a
    picture.
    """
    in_time: int
    """Number of frames whose own picture was on the screen when the next frame arrived."""
    behind: Mapping[int, int]
    """Number of frames by lateness of the displayed picture, in frames.

    Key `MOST_BEHIND` includes all greater latenesses.
    """
    states: Mapping[str, int]
    """Number of displayed pictures by status label."""


class LiveSums:
    """Streaming accumulator of displayed pictures; the result is `live`."""

    def __init__(self, record: Record | None = None) -> None:
        """Create an empty accumulator; `record` receives the figures of each scored frame."""
        self._record = record
        self._score, self._settled = ScoreSums(), ScoreSums()
        self._before = ScoredMean(), ScoredMean()
        self._settled_before = ScoredMean(), ScoredMean()
        self._when_shown, self._on_screen = AgeHistogram(), AgeHistogram()
        self._behind: Counter[int] = Counter()
        self._states: Counter[str] = Counter()
        self._first_s: float | None = None

    def picture(self, age_ms: float, state: str) -> None:
        """Count a displayed picture by its age in milliseconds and its status label."""
        self._when_shown.add(age_ms)
        known = state in self._states or len(self._states) < _MAX_STATES
        self._states[state if known else "other"] += 1

    def frame(
        self, quality: FrameQuality, time_s: float, behind: int, age_ms: float, before_db: tuple[float, float]
    ) -> None:
        """Score the picture that was on the screen when the next frame arrived.

        Args:
            quality: quality of the picture against frame `quality.seq`, the newest one at that time.
            time_s: recording time of that frame in seconds.
            behind: lateness of the picture in frames.
            age_ms: age of the picture at that moment in milliseconds.
            before_db: PSNR in dB of the previous raw frame, over tissue and over the whole frame; NaN if unavailable.
        """
        if self._first_s is None:
            self._first_s = time_s
        self._on_screen.add(age_ms)
        self._behind[min(max(behind, 0), MOST_BEHIND)] += 1
        self._score.take(quality)
        settled = time_s - self._first_s >= SETTLING_S
        for means in (self._before, self._settled_before) if settled else (self._before,):
            for mean, value in zip(means, before_db, strict=True):
                mean.add(value)
        if settled:
            self._settled.take(quality)
        if self._record is not None:
            own = {"seq": quality.seq, "time_s": time_s, "trained": True, "model_version": 0}
            self._record(
                {
                    **own,
                    **measures(quality),
                    "age_ms": age_ms,
                    "behind": behind,
                    "previous_frame_db": finite(before_db[0]),
                }
            )

    def leave_out(self, reason: str) -> None:
        """Count a frame that is not scored."""
        self._score.leave_out(reason)

    @property
    def live(self) -> Live:
        """Results of all frames so far."""
        return Live(
            score=self._score.score,
            settled=self._settled.score,
            previous=_baseline(self._before),
            settled_previous=_baseline(self._settled_before),
            age_when_shown=self._when_shown.ages(),
            age_on_screen=self._on_screen.ages(),
            in_time=self._behind[0],
            behind=dict(sorted(self._behind.items())),
            states=dict(sorted(self._states.items())),
        )


def _baseline(means: tuple[ScoredMean, ScoredMean]) -> BaselineScore:
    return BaselineScore(means[0].mean, means[1].mean, means[0].count)
