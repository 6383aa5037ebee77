"""Quality scores with trivial baselines, and a digest of the displayed pictures.

A replay scores each displayed frame. A live stream scores each frame against the picture on display when the next frame arrives.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import OrderedDict, deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsplat_core.memory import return_freed_memory
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import FrameQuality, QualityTracker, ScoredMean, psnr_tissue_db
from operators.frame_log import FrameLog, LogLine, Value
from operators.graph import ConditionType, MessageOrTimeoutCondition, Operator, OperatorSpec
from operators.messages import Prediction, RenderedFrame, ShownPicture
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class ScoredFrame:
    """A displayed frame and its quality."""

    rendered: RenderedFrame
    quality: FrameQuality
    """Scores of the picture. For a frame trained on before display they measure the training
    error.
    """
    previous_frame_db: float
    """Tissue PSNR in dB of the previous raw frame as a prediction (trivial baseline). NaN for the
    first frame.
    """
    next_frame_db: float = math.nan
    """Tissue PSNR in dB of the prediction made before training on this frame; NaN without a
    prediction.
    """

    def as_json(self) -> LogLine:
        """Return one entry of the report's series, with None for missing measures."""
        frame = self.rendered.frame
        measures = {
            "psnr_tissue_db": self.quality.psnr_tissue_db,
            "psnr_frame_db": self.quality.psnr_frame_db,
            "ssim": self.quality.ssim,
            "previous_frame_db": self.previous_frame_db,
            "next_frame_db": self.next_frame_db,
        }
        return {
            "seq": frame.seq,
            "time_s": frame.time_s,
            "trained": self.rendered.trained,
            "model_version": self.rendered.model_version,
            **{name: value if math.isfinite(value) else None for name, value in measures.items()},
        }


@dataclass(frozen=True)
class NextFrameResult:
    """Accuracy of predictions of frames before training on them, as opposed to the training
    error.
    """

    psnr_tissue_db: float | None
    """Mean tissue PSNR of the predictions, in dB."""
    previous_frame_db: float | None
    """Mean tissue PSNR in dB of the previous raw frame over the same frames (trivial baseline)."""
    frames: int
    """Number of frames with both values."""


class NextFrameScores:
    """Running means of predictions and of their trivial baseline, over frames that have both."""

    def __init__(self) -> None:
        self._predicted, self._previous = ScoredMean(), ScoredMean()

    def add(self, predicted_db: float, previous_db: float) -> None:
        """Add the PSNR of one frame's prediction and of the previous frame shown in its place, in dB. Ignored if
        either is not finite.
        """
        if math.isfinite(predicted_db) and math.isfinite(previous_db):
            self._predicted.add(predicted_db)
            self._previous.add(previous_db)

    @property
    def result(self) -> NextFrameResult:
        """Means over the frames so far."""
        return NextFrameResult(self._predicted.mean, self._previous.mean, self._predicted.count)


def prediction_db(prediction: Prediction | None) -> float:
    """Return the tissue PSNR of a prediction against its frame, in dB; NaN without a prediction."""
    if prediction is None or prediction.image is None:
        return math.nan
    return psnr_tissue_db(prediction.image, prediction.frame.image, prediction.frame.mask)


@dataclass(frozen=True)
class QualityResult:
    """Scores of all displayed frames of a run."""

    trained: QualityTracker
    """Frames trained on before display; their scores are training errors."""
    held_out: QualityTracker
    """Frames displayed and never trained on."""
    series: tuple[LogLine, ...]
    """One entry per displayed frame in order, or per bin of frames in a long run (see
    `frame_log.series`).
    """
    frames_per_entry: int
    frames_sha256: str
    frames: int
    """Number of displayed frames, including damaged ones, which are not scored."""


class MetricsOp(Operator):
    """Scores each displayed frame against its raw frame on tissue, and hashes the displayed bytes.

    The digest is SHA-256 over the line `seq width height\\n` and the RGB bytes of each
    reconstruction, in order. Only running means are kept in memory; the log holds the scores of
    each frame. A damaged frame enters digest and log without scores, because its pixels are the
    decoder's concealment.

    Inputs:
        rendered: `RenderedFrame`.
        predicted: `Prediction` of the same frame; optional.

    Outputs:
        scored: `ScoredFrame`.

    Params:
        log: per-frame log; without it the result has no series.
    """

    def __init__(self, fragment: Any, *args: Any, log: FrameLog | None = None, **kwargs: Any) -> None:
        self.log = log
        self.live = QualityTracker()
        """Frames trained on before display."""
        self.held_out = QualityTracker()
        """Frames displayed and never trained on."""
        self.frames = 0
        """Number of frames so far."""
        self.next_frame = NextFrameScores()
        self._digest = hashlib.sha256()
        self._hashing = ThreadPoolExecutor(1, thread_name_prefix="hash frames")
        self._previous: Frame | None = None
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)
        spec.input("predicted", type=Prediction, optional=True)
        spec.output("scored", type=ScoredFrame)

    def start(self) -> None:
        self.live, self.held_out, self.frames = QualityTracker(), QualityTracker(), 0
        self.next_frame = NextFrameScores()
        self._digest = hashlib.sha256()
        self._hashing = ThreadPoolExecutor(1, thread_name_prefix="hash frames")
        self._previous = None
        if self.log is not None:
            self.log.open()

    def stop(self) -> None:
        self._hashing.shutdown()
        self._previous = None
        if self.log is not None:
            self.log.close()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        rendered: RenderedFrame = op_input.receive("rendered")
        frame, previous = rendered.frame, self._previous
        self._digest.update(f"{frame.seq} {frame.width_px} {frame.height_px}\n".encode())
        # Hashing runs in parallel to scoring; neither holds the GIL for long.
        hashed = self._hashing.submit(self._digest.update, np.ascontiguousarray(rendered.image).data)
        self.frames += 1
        quality, before_db = FrameQuality(frame.seq, math.nan, math.nan, math.nan), math.nan
        if frame.status is not FrameStatus.DAMAGED:
            tracker = self.live if rendered.trained else self.held_out
            quality = tracker.observe(frame.seq, rendered.image, frame.image, frame.mask)
            if previous is not None and previous.image.shape == frame.image.shape:
                before_db = psnr_tissue_db(previous.image, frame.image, frame.mask)
        next_db = prediction_db(op_input.receive("predicted"))
        self.next_frame.add(next_db, before_db)
        hashed.result()
        scored = ScoredFrame(rendered, quality, before_db, next_db)
        if self.log is not None:
            self.log.write(scored.as_json())
        self._previous = frame
        op_output.emit(scored, "scored")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        entries, per_entry = self.log.series(self.frames) if self.log is not None else ((), 1)
        if self.log is not None and self.frames:
            outcome.output("frames", self.log.path)
        outcome.add(QualityResult(self.live, self.held_out, entries, per_entry, self.frames_sha256, self.frames))
        outcome.add(self.next_frame.result)

    @property
    def frames_sha256(self) -> str:
        """SHA-256 of the frames so far, in hex."""
        return self._digest.hexdigest()


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
