"""Scores of a live stream: each frame against the picture on display when the next frame
arrived.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsplat_core.memory import return_freed_memory
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import FrameQuality, QualityTracker, ScoredMean, psnr_tissue_db
from operators.frame_log import FrameLog, Value
from operators.graph import ConditionType, MessageOrTimeoutCondition, Operator, OperatorSpec
from operators.messages import Prediction, ShownPicture
from operators.metrics import NextFrameScores, QualityResult, ScoredFrame, prediction_db
from operators.outcome import OutcomeBuilder

LOOK_NS = 500_000_000
WAITING = 8
"""Capacity of each input queue, in messages. A full queue drops its oldest message; dropped frames
are counted as unscored.
"""
PREDICTIONS_KEPT = 64
"""Maximum number of stored scores whose counterpart (prediction or baseline) has not arrived."""
TRIM_EVERY_S = 30.0
"""Period for returning free heap memory to the operating system, in seconds."""
SIMILARITY_EVERY = 8
"""SSIM is several times slower than PSNR, so it is computed for one in this many frames."""
SETTLING_S = 1.0
"""Start-up time in seconds that is excluded from settled scores, because the model is being
initialised.
"""


@dataclass(frozen=True)
class OnScreenResult:
    """Scores of a live stream that complement `QualityResult`."""

    settled_db: float | None
    """Mean tissue PSNR after the first second, in dB: training error of the displayed pictures,
    including their latency.
    """
    worst_db: float | None
    """Lowest tissue PSNR of a frame after the first second, in dB."""
    worst_seq: int | None
    """Sequence number of the frame with the lowest PSNR."""
    previous_frame_db: float | None
    """Mean tissue PSNR in dB of the previous raw frame after the first second (trivial
    baseline).
    """
    previous_frame_throughout_db: float | None
    """Mean tissue PSNR in dB of the previous raw frame over all scored frames (trivial
    baseline).
    """
    frames: int
    """Number of scored frames."""
    not_on_screen: int
    """Scored frames whose own picture was not on display when the next frame arrived."""
    unscored: int
    """Frames that arrived too fast to be scored."""


class OnScreenMetricsOp(Operator):
    """Scores each frame against the picture on display when the next frame arrived.

    This is the frame's own picture or, if that was late, an older one. Overlays are not scored.
    Most frames were trained on before display, so the scores are training errors. Predictions are
    scored separately after the first second (`NextFrameResult`).

    Inputs:
        frame: `Frame`, as it enters reconstruction.
        shown: `ShownPicture`.
        predicted: `Prediction` of some of the frames; optional.

    Outputs:
        scored: `ScoredFrame`.

    Params:
        log: per-frame log; without it the result has no series.
        report: also compute SSIM and the digest, and contribute `QualityResult`; needed for reports
            only.
    """

    def __init__(
        self, fragment: Any, *args: Any, log: FrameLog | None = None, report: bool = True, **kwargs: Any
    ) -> None:
        self.log, self.report = log, report
        self._reset()
        super().__init__(fragment, MessageOrTimeoutCondition(fragment, LOOK_NS), *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        for name, kind in (("frame", Frame), ("shown", ShownPicture), ("predicted", Prediction)):
            optional = name == "predicted"
            port = spec.input(name, policy="drop_oldest", type=kind, optional=optional).condition(ConditionType.NONE)
            port.connector(port.ConnectorType.DEFAULT, capacity=WAITING)
        spec.output("scored", type=ScoredFrame, optional=True).condition(ConditionType.NONE)

    def start(self) -> None:
        self._reset()
        if self.log is not None:
            self.log.open()

    def stop(self) -> None:
        if self._frames:
            # The last frame has no successor and is scored against the final picture.
            self._frames.append(None)
            self._score_waiting(waiting=0)
        self._frames.clear()
        self._shown.clear()
        self._predicted.clear()
        if self.log is not None:
            self.log.close()

    def _reset(self) -> None:
        self.quality = QualityTracker()
        """Scores of all frames."""
        self.settled, self.before, self.before_throughout = ScoredMean(), ScoredMean(), ScoredMean()
        self.worst: tuple[float, int] | None = None
        self.next_frame = NextFrameScores()
        self.frames = self.not_on_screen = self.unscored = 0
        self._digest = hashlib.sha256()
        self._frames: deque[Frame | None] = deque()
        self._shown: deque[ShownPicture] = deque()
        self._predicted: OrderedDict[int, float] = OrderedDict()
        """Tissue PSNR in dB of predictions whose frame is not scored yet, by sequence number."""
        self._waiting_db: OrderedDict[int, float] = OrderedDict()
        """Tissue PSNR in dB of the previous raw frame, for frames whose prediction has not
        arrived.
        """
        self._on_screen: ShownPicture | None = None
        self._previous: Frame | None = None
        self._first_s: float | None = None
        self._last_seq: int | None = None
        self._trimmed_s = time.monotonic()
        self._log_works = True

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        shown: ShownPicture | None
        while (shown := op_input.receive("shown")) is not None:
            if shown.new:
                self._shown.append(shown)
        frame: Frame | None
        while (frame := op_input.receive("frame")) is not None:
            self._frames.append(frame)
        prediction: Prediction | None
        while (prediction := op_input.receive("predicted")) is not None:
            self._take(prediction)
        # Pictures lag behind frames, so a frame is scored once the two following frames have
        # arrived.
        for scored in self._score_waiting(waiting=2):
            op_output.emit(scored, "scored")
        while len(self._shown) > 4 * WAITING:
            self._show(self._shown.popleft())
        now_s = time.monotonic()
        if now_s - self._trimmed_s > TRIM_EVERY_S:
            # Freed pictures fragment the heap; without trimming, resident memory grows for hours.
            self._trimmed_s = now_s
            return_freed_memory()

    def _score_waiting(self, waiting: int) -> list[ScoredFrame]:
        """Score the oldest frames until `waiting` frames remain in the queue, and return the
        scores.
        """
        scores = []
        while len(self._frames) > max(1, waiting):
            frame, following = self._frames[0], self._frames[1]
            self._frames.popleft()
            if frame is not None and (scored := self._score(frame, following)) is not None:
                scores.append(scored)
        return scores

    def _take(self, prediction: Prediction) -> None:
        """Score a prediction. On a slow machine it arrives after its frame was scored."""
        value, seq = prediction_db(prediction), prediction.frame.seq
        if not math.isfinite(value):
            return
        before_db = self._waiting_db.pop(seq, None)
        if before_db is not None:
            self.next_frame.add(value, before_db)
        else:
            _keep(self._predicted, seq, value)

    def _show(self, picture: ShownPicture) -> None:
        self._on_screen = picture
        if not self.report:
            return
        frame = picture.rendered.frame
        self._digest.update(f"{frame.seq} {frame.width_px} {frame.height_px}\n".encode())
        self._digest.update(np.ascontiguousarray(picture.rendered.image).data)

    def _score(self, frame: Frame, following: Frame | None) -> ScoredFrame | None:
        until_ns = math.inf if following is None or following.arrived_ns is None else following.arrived_ns
        while self._shown and self._shown[0].shown_ns <= until_ns:
            self._show(self._shown.popleft())
        if self._last_seq is not None:
            self.unscored += max(0, frame.seq - self._last_seq - 1)
        self._last_seq = frame.seq
        previous, self._previous = self._previous, frame
        on_screen = self._on_screen
        if on_screen is None or on_screen.rendered.image.shape != frame.image.shape:
            return None
        self.frames += 1
        before_db = math.nan
        scorable = frame.status is not FrameStatus.DAMAGED and frame.withheld is None
        if scorable:
            quality = self.quality.observe(
                frame.seq, on_screen.rendered.image, frame.image, frame.mask,
                similarity=self.report and self.frames % SIMILARITY_EVERY == 1,
            )  # fmt: skip
            if previous is not None and previous.image.shape == frame.image.shape:
                before_db = psnr_tissue_db(previous.image, frame.image, frame.mask)
        else:
            quality = FrameQuality(frame.seq, math.nan, math.nan, math.nan)
        self._count(frame, on_screen, quality, before_db)
        scored = ScoredFrame(on_screen.rendered, quality, before_db, self._next_frame_db(frame, before_db))
        if self.log is not None and self._log_works:
            # Do not write again in `stop` after a failed write, so that the error is reported once.
            self._log_works = False
            self.log.write(_entry(scored, frame, on_screen, until_ns))
            self._log_works = True
        return scored

    def _count(self, frame: Frame, on_screen: ShownPicture, quality: FrameQuality, before_db: float) -> None:
        if on_screen.rendered.frame.seq != frame.seq:
            self.not_on_screen += 1
        if self._first_s is None:
            self._first_s = frame.time_s
        self.before_throughout.add(before_db)
        if not self._is_settled(frame):
            return
        value = quality.psnr_tissue_db
        self.settled.add(value)
        self.before.add(before_db)
        if math.isfinite(value) and (self.worst is None or value < self.worst[0]):
            self.worst = value, frame.seq

    def _is_settled(self, frame: Frame) -> bool:
        return self._first_s is not None and frame.time_s - self._first_s >= SETTLING_S

    def _next_frame_db(self, frame: Frame, before_db: float) -> float:
        """Return the PSNR of the frame's prediction in dB; NaN if it has not arrived.

        After the start-up time the pair is added to the means, or the baseline is kept until the
        prediction arrives.
        """
        value = self._predicted.pop(frame.seq, math.nan)
        if self._is_settled(frame) and math.isfinite(before_db):
            if math.isfinite(value):
                self.next_frame.add(value, before_db)
            else:
                _keep(self._waiting_db, frame.seq, before_db)
        return value

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        if self.report:
            entries, per_entry = self.log.series(self.frames) if self.log is not None else ((), 1)
            if self.log is not None and self.frames:
                outcome.output("frames", self.log.path)
            sha256 = self._digest.hexdigest()
            outcome.add(QualityResult(self.quality, QualityTracker(), entries, per_entry, sha256, self.frames))
        outcome.add(self.next_frame.result)
        worst_db, worst_seq = self.worst or (None, None)
        outcome.add(
            OnScreenResult(
                self.settled.mean, worst_db, worst_seq, self.before.mean, self.before_throughout.mean, self.frames,
                self.not_on_screen, self.unscored,
            )
        )  # fmt: skip


def _keep(values: OrderedDict[int, float], seq: int, value: float) -> None:
    values[seq] = value
    while len(values) > PREDICTIONS_KEPT:
        values.popitem(last=False)


def _entry(scored: ScoredFrame, frame: Frame, on_screen: ShownPicture, until_ns: float) -> Mapping[str, Value]:
    """Return the log entry of a frame: its scores and the state of the display."""
    rendered = on_screen.rendered
    arrived_ns = (rendered.content or rendered.frame).arrived_ns
    return {
        **scored.as_json(),
        "seq": frame.seq,
        "time_s": frame.time_s,
        "arrived_ns": frame.arrived_ns,
        "shown_seq": rendered.frame.seq,
        "shown_ns": on_screen.shown_ns,
        "age_ms": round(on_screen.age_ns * 1e-6, 3),
        "state": on_screen.state.value,
        "taken_ms": _since(arrived_ns, rendered.taken_ns),
        "published_ms": _since(arrived_ns, rendered.published_ns),
        "steps": rendered.steps,
        "withheld": frame.withheld,
    }


def _since(arrived_ns: int | None, now_ns: int | None) -> float | None:
    """Return the milliseconds between two timestamps; None if either is unknown."""
    return None if arrived_ns is None or now_ns is None else round((now_ns - arrived_ns) * 1e-6, 3)
