"""Scores of pictures against frames: sums of constant size, reasons for excluding frames, and the scores of a live run.

A live run is scored by the picture on the screen when frame i+1 arrives, against frame i. This picture is the last one
displayed before that moment. It shows frame i if frame i was processed in time, otherwise an older frame. Pictures that were
replaced before that moment are not scored. Nothing is scored while a stopped source sends no frames.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import (
    MEASURES,
    SETTLING_S,
    FrameQuality,
    ImageLike,
    QualityTracker,
    ScoredMean,
    frame_quality,
)

Entry = dict[str, float | int | bool | str | None]
"""Measures of one frame by name; None for a measure that the frame does not have."""
Record = Callable[[Entry], None]
"""Callback that receives each frame's measures in order."""


@dataclass(frozen=True)
class Score:
    """Image quality of the frames of one protocol, averaged over frames.

    PSNR is averaged in decibels. A measure is None if no frame has it.
    """

    psnr_tissue_db: float | None
    psnr_frame_db: float | None
    ssim: float | None
    frames: int
    """Number of scored frames."""
    worst_db: float | None
    """Lowest tissue PSNR of any frame, in dB."""
    worst_seq: int | None
    """Sequence number of the frame with the lowest tissue PSNR."""
    left_out: Mapping[str, int]
    """Numbers of excluded frames by reason."""


@dataclass(frozen=True)
class BaselineScore:
    """Mean PSNRs of one baseline in decibels over `frames` frames; a field is None if no frame has the measure."""

    psnr_tissue_db: float | None = None
    psnr_frame_db: float | None = None
    frames: int = 0
    psnr_both_db: float | None = None
    """PSNR of a copy over pixels that are tissue both in the frame and in the copy.

    Published frame-hold curves use this mask, so tissue occluded in the copy does not count as error.
    """


def why_left_out(frame: Frame) -> str | None:
    """Return the reason to exclude a frame from scoring, or None to score it.

    Damaged frames contain guesses of the decoder. Withheld frames are blurred, smoky or outside the
    body. Frames without tissue pixels offer nothing to compare.
    """
    if frame.status is FrameStatus.DAMAGED:
        return "damaged"
    if frame.withheld is not None:
        return "withheld"
    if frame.tissue is not None and not frame.tissue.any():
        return "no tissue"
    return None


class ScoreSums:
    """Streaming accumulator of frame scores; the result is `score`."""

    def __init__(self) -> None:
        self._quality = QualityTracker()
        self._left_out: Counter[str] = Counter()
        self._worst = math.inf
        self._worst_seq: int | None = None

    def add(self, frame: Frame, picture: ImageLike) -> FrameQuality:
        """Compare a picture with its frame and add the result.

        Args:
            frame: reference frame.
            picture: [H, W, 3], uint8 or float in 0..1.

        Raises:
            InvalidInput: if the sizes differ.
        """
        quality = frame_quality(frame.seq, picture, frame.image, frame.tissue)
        self.take(quality)
        return quality

    def take(self, quality: FrameQuality) -> None:
        """Add the measures of a frame that the caller has computed; non-finite values count as missing."""
        self._quality.take(quality)
        if quality.psnr_tissue_db < self._worst:
            self._worst, self._worst_seq = quality.psnr_tissue_db, quality.seq

    def leave_out(self, reason: str) -> None:
        """Count a frame that is excluded from the score, by its reason."""
        self._left_out[reason] += 1

    @property
    def score(self) -> Score:
        """Mean scores of all frames added so far."""
        worst = None if self._worst_seq is None else self._worst
        means = self._quality.means()
        return Score(
            **means,
            frames=self._quality.count,
            worst_db=worst,
            worst_seq=self._worst_seq,
            left_out=dict(sorted(self._left_out.items())),
        )


def measures(quality: FrameQuality) -> Entry:
    """Return the measures of a frame by name, for a log."""
    return {name: finite(getattr(quality, name)) for name in MEASURES}


def finite(value: float | None) -> float | None:
    """Return the value, or None if it is not a finite number."""
    return value if value is not None and math.isfinite(value) else None


def number(entry: Entry, name: str) -> float | None:
    """Return the measure `name` of a log entry as a number, or None if the entry does not have it."""
    value = entry.get(name)
    return None if value is None or isinstance(value, str) else float(value)


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
    """Histogram of picture ages in logarithmic buckets, each 1 % wide."""

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
"""Largest lateness, in frames, that is counted separately. Pictures that are later are counted with it."""
NOTHING_SHOWN = "nothing shown yet"
_MAX_STATES = 16


@dataclass(frozen=True)
class Live:
    """Image quality and latency of the pictures that were displayed in a live run."""

    score: Score
    settled: Score
    """Score over the frames after the first `SETTLING_S` seconds, without the start-up of training."""
    previous: BaselineScore
    """Baseline for `score`: the previous received frame in place of the displayed picture, over the same frames and pixels."""
    settled_previous: BaselineScore
    """Baseline for `settled`: the previous received frame in place of the displayed picture, over the same frames and pixels."""
    age_when_shown: Ages | None
    """Time from a frame's arrival until its picture is displayed; None without a picture."""
    age_on_screen: Ages | None
    """Age of the displayed picture at the arrival of the next frame, at least one frame interval; None without a
    picture.
    """
    in_time: int
    """Number of frames whose own picture was on the screen when the next frame arrived."""
    behind: Mapping[int, int]
    """Number of frames by the lateness in frames of the picture that was on the screen when the next frame arrived.

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
        """Count a frame that is not scored, by its reason."""
        self._score.leave_out(reason)

    @property
    def live(self) -> Live:
        """Scores and latencies of all frames and displayed pictures added so far."""
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
