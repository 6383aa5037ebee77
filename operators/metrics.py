"""Quality scores with trivial baselines, a digest of the displayed pictures, and their comparison with those of a session.

A run without a clock scores each frame against its own picture. A live stream scores each frame against the picture on display when the next frame arrives.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsplat_core.io.sessions.records import ShownLine
from gsplat_core.machine import return_freed_memory
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import SETTLING_S, FrameQuality, QualityTracker, ScoredMean, psnr_tissue_db
from operators.frame_log import FrameLog, LogLine, Value
from operators.graph import ConditionType, MessageOrTimeoutCondition, Operator, OperatorSpec
from operators.messages import Prediction, RenderedFrame, ShownPicture
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class ScoredFrame:
    """A displayed frame with its rendered picture and its scores."""

    rendered: RenderedFrame
    quality: FrameQuality
    """Scores of the picture. For a frame trained on before display they measure the training error."""
    previous_frame_db: float
    """Tissue PSNR in dB of the previous raw frame as a prediction (trivial baseline), see `Frame.can_be_shown`. NaN for the
    first frame and after a change of size.
    """
    next_frame_db: float = math.nan
    """Tissue PSNR in dB of the prediction made before training on this frame; NaN without a prediction."""

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
    """Accuracy of pictures predicted before training on their frames. Unlike the scores of displayed pictures, it is no
    training error.
    """

    psnr_tissue_db: float | None
    """Mean tissue PSNR of the predictions, in dB; None if `frames` is 0."""
    previous_frame_db: float | None
    """Mean tissue PSNR in dB of the previous raw frame over the same frames (trivial baseline); None if `frames` is 0."""
    frames: int
    """Number of frames that have both a prediction score and a baseline score."""


class NextFrameScores:
    """Running means of predictions and of their trivial baseline, over frames that have both."""

    def __init__(self) -> None:
        self._predicted, self._previous = ScoredMean(), ScoredMean()

    def add(self, predicted_db: float, previous_db: float) -> None:
        """Add one frame's scores in dB: its prediction and the previous raw frame. Ignored if either is not finite."""
        if math.isfinite(predicted_db) and math.isfinite(previous_db):
            self._predicted.add(predicted_db)
            self._previous.add(previous_db)

    @property
    def result(self) -> NextFrameResult:
        """Return the means over the frames so far."""
        return NextFrameResult(self._predicted.mean, self._previous.mean, self._predicted.count)


def prediction_db(prediction: Prediction | None) -> float:
    """Return the tissue PSNR of a prediction against its frame, in dB; NaN without a prediction."""
    if prediction is None or prediction.image is None:
        return math.nan
    return psnr_tissue_db(prediction.image, prediction.frame.image, prediction.frame.tissue)


@dataclass(frozen=True)
class BetweenNeighbours:
    """Scores over the held-out frames that have a previous and a next frame."""

    psnr_tissue_db: float
    """Mean tissue PSNR of the displayed pictures, in dB."""
    neighbour_mean_db: float
    """Mean tissue PSNR in dB of the mean of the previous and the next raw frame (trivial baseline, which sees the future)."""
    frames: int


@dataclass(frozen=True)
class QualityResult:
    """Scores of all displayed frames of a run."""

    trained: QualityTracker
    """Frames trained on before display; their scores are training errors."""
    held_out: QualityTracker
    """Frames displayed and never trained on."""
    series: tuple[LogLine, ...]
    """One entry per displayed frame in order, or per bin of frames in a long run (see `frame_log.series`)."""
    frames_per_entry: int
    frames_sha256: str
    frames: int
    """Number of frames compared with a displayed picture, their own or an older one. Includes withheld and damaged frames,
    which have no score.
    """
    previous_frame_db: float | None = None
    """Mean tissue PSNR in dB of the previous raw frame over the scored frames (trivial baseline); None if there is none."""
    heldout_previous_frame_db: float | None = None
    """That mean over held-out frames only."""
    heldout_between: BetweenNeighbours | None = None
    """Comparison with the mean of the previous and the next raw frame; None if no held-out frame has both."""


POLL_NS = 500_000_000
WAITING = 8
"""Capacity of each input queue, in messages. A full queue drops its oldest message; dropped frames
are counted as unscored.
"""
PREDICTIONS_KEPT = 64
"""Maximum number of stored scores whose counterpart (prediction or baseline) has not arrived."""
TRIM_EVERY_S = 30.0
"""Period for returning free heap memory to the operating system, in seconds."""
SIMILARITY_EVERY = 8
"""Compute SSIM for one in this many frames, because it is several times slower than PSNR."""


@dataclass(frozen=True)
class OnScreenResult:
    """Scores of a live stream that complement `QualityResult`. Scores are None if no frame was scored."""

    settled_db: float | None
    """Mean tissue PSNR after the first second, in dB: training error of the displayed pictures,
    including their latency.
    """
    worst_db: float | None
    """Lowest tissue PSNR of a frame after the first second, in dB."""
    worst_seq: int | None
    """Sequence number of the frame with the lowest PSNR, `worst_db`."""
    previous_frame_db: float | None
    """Mean tissue PSNR in dB of the previous raw frame after the first second (trivial baseline)."""
    frames: int
    """Number of frames scored against a displayed picture."""
    not_on_screen: int
    """Number of frames scored against an older picture, because their own was not on display when the next frame
    arrived."""
    unscored: int
    """Number of frames dropped unscored, because frames arrived faster than they could be scored."""


class PictureDigest:
    """SHA-256 over the line `seq width height\\n` and the RGB bytes of each reconstruction, in order.

    Hashing runs in a thread, in parallel to scoring; neither holds the GIL for long.
    """

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._thread: ThreadPoolExecutor | None = None
        self._newest: Future[None] | None = None

    def add(self, rendered: RenderedFrame) -> None:
        """Start hashing the picture of a frame. Waits until the previous one is hashed."""
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, thread_name_prefix="hash frames")
        self._wait()
        frame = rendered.frame
        self._digest.update(f"{frame.seq} {frame.width_px} {frame.height_px}\n".encode())
        self._newest = self._thread.submit(self._digest.update, np.ascontiguousarray(rendered.image).data)

    def hexdigest(self) -> str:
        """Return the digest of the pictures so far, in hex."""
        self._wait()
        return self._digest.hexdigest()

    def close(self) -> None:
        """End the hashing thread. `hexdigest` remains usable."""
        if self._thread is not None:
            self._thread.shutdown()

    def _wait(self) -> None:
        if self._newest is not None:
            self._newest.result()


class OnScreen:
    """Assigns to each frame the picture that was on display when the following frame arrived.

    This is the frame's own reconstruction or, if that was late, the reconstruction of an older frame.
    """

    def __init__(self, show: Callable[[ShownPicture], None]) -> None:
        """Start without frames and pictures. show: called with each picture in the order of display."""
        self._show = show
        self._frames: deque[Frame | None] = deque()
        self._shown: deque[ShownPicture] = deque()
        self._current: ShownPicture | None = None
        self._last_seq: int | None = None
        self.unscored = 0
        """Number of frames dropped unscored, because frames arrived faster than they could be scored."""

    def add_picture(self, shown: ShownPicture) -> None:
        """Add a picture in the order of display. Repetitions are ignored."""
        if shown.new:
            self._shown.append(shown)

    def add_frame(self, frame: Frame) -> None:
        """Add a frame in the order of arrival."""
        self._frames.append(frame)

    def end(self) -> None:
        """Mark the end of the stream, so that `pairs` assigns the final picture to the last frame."""
        if self._frames:
            self._frames.append(None)

    def pairs(self, waiting: int) -> Iterator[tuple[Frame, ShownPicture | None, float]]:
        """Yield the oldest frames until `waiting` frames remain, each with its assigned picture and the arrival time of
        the following frame in nanoseconds, infinite for the last frame. The picture is None if none of the frame's size
        was on display.
        """
        while len(self._frames) > max(1, waiting):
            frame, following = self._frames.popleft(), self._frames[0]
            assert frame is not None
            until_ns = math.inf if following is None or following.arrived_ns is None else following.arrived_ns
            while self._shown and self._shown[0].shown_ns <= until_ns:
                self._display(self._shown.popleft())
            if self._last_seq is not None:
                self.unscored += max(0, frame.seq - self._last_seq - 1)
            self._last_seq = frame.seq
            current = self._current
            fits = current is not None and current.rendered.image.shape == frame.image.shape
            yield frame, current if fits else None, until_ns
        while len(self._shown) > 4 * WAITING:
            self._display(self._shown.popleft())

    def _display(self, shown: ShownPicture) -> None:
        self._current = shown
        self._show(shown)


class MetricsOp(Operator):
    """Scores frames against displayed pictures on tissue, and hashes the displayed bytes.

    Without a clock each frame is scored against its own picture. With `on_screen` it is scored
    against the picture on display when the next frame arrived; overlays are not scored. Frames that
    were trained on before display have training errors. Predictions are scored separately
    (`NextFrameResult`), in a live stream after the first second.

    Only running means are kept in memory; the log holds the scores of each frame. A damaged or
    withheld frame enters digest and log without scores.

    Inputs:
        rendered: `RenderedFrame`; without `on_screen`.
        frame: `Frame`, as it enters reconstruction; with `on_screen`.
        shown: `ShownPicture`; with `on_screen`.
        predicted: `Prediction` of some of the frames; optional.

    Outputs:
        scored: `ScoredFrame`.

    Params:
        on_screen: score the pictures of a live display.
        log: per-frame log; without it the result has no series.
        report: compute SSIM and the digest, and contribute `QualityResult`; needed for reports
            only.
    """

    _previous: Frame | None
    """Newest raw frame that the display follows, the trivial baseline for the next frame; None at the start of a stream."""
    _without_next: tuple[Frame, Frame, float] | None
    """Newest held-out frame, after its previous frame and before its own PSNR in dB, until the next frame arrives; None otherwise.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        on_screen: bool = False,
        log: FrameLog | None = None,
        report: bool = True,
        **kwargs: Any,
    ) -> None:
        self.on_screen, self.log, self.report = on_screen, log, report
        self._digest = PictureDigest()
        self._reset()
        conditions = (MessageOrTimeoutCondition(fragment, POLL_NS),) if on_screen else ()
        super().__init__(fragment, *conditions, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        if not self.on_screen:
            spec.input("rendered", type=RenderedFrame)
            spec.input("predicted", type=Prediction, optional=True)
            spec.output("scored", type=ScoredFrame, optional=True)
            return
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
        self._screen.end()
        for frame, shown, until_ns in self._screen.pairs(waiting=0):
            self._score_shown(frame, shown, until_ns)
        self._digest.close()
        self._previous = self._without_next = None
        if self.log is not None:
            self.log.close()

    def _reset(self) -> None:
        self.trained, self.held_out = QualityTracker(), QualityTracker()
        """Scores of frames trained on before display, and of frames never trained on."""
        self.frames = 0
        """Number of frames compared with a displayed picture so far, scored or not."""
        self.next_frame = NextFrameScores()
        self.settled, self.before = ScoredMean(), ScoredMean()
        self.before_all, self.before_held_out = ScoredMean(), ScoredMean()
        self.between, self.neighbour_mean = ScoredMean(), ScoredMean()
        """Pictures of held-out frames with both neighbours, and means of these neighbours."""
        self.worst: tuple[float, int] | None = None
        self.not_on_screen = 0
        self._digest.close()
        self._digest = PictureDigest()
        self._screen = OnScreen(self._hash)
        self._predicted: OrderedDict[int, float] = OrderedDict()
        """Tissue PSNR in dB of predictions whose frame is not scored yet, by sequence number."""
        self._waiting_db: OrderedDict[int, float] = OrderedDict()
        """Tissue PSNR in dB of the previous raw frame, for frames whose prediction has not arrived."""
        self._previous = None
        self._without_next = None
        self._first_s: float | None = None
        self._trimmed_s = time.monotonic()
        self._log_works = True

    @property
    def frames_sha256(self) -> str:
        """SHA-256 of the pictures so far, in hex."""
        return self._digest.hexdigest()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        if not self.on_screen:
            rendered: RenderedFrame = op_input.receive("rendered")
            self._digest.add(rendered)
            self._take(op_input.receive("predicted"))
            op_output.emit(self._score_own(rendered), "scored")
            return
        shown: ShownPicture | None
        while (shown := op_input.receive("shown")) is not None:
            self._screen.add_picture(shown)
        frame: Frame | None
        while (frame := op_input.receive("frame")) is not None:
            self._screen.add_frame(frame)
        prediction: Prediction | None
        while (prediction := op_input.receive("predicted")) is not None:
            self._take(prediction)
        # Pictures lag behind frames, so a frame is scored once the two following frames have arrived.
        for frame, shown, until_ns in self._screen.pairs(waiting=2):
            if (scored := self._score_shown(frame, shown, until_ns)) is not None:
                op_output.emit(scored, "scored")
        now_s = time.monotonic()
        if now_s - self._trimmed_s > TRIM_EVERY_S:
            # Freed pictures fragment the heap; without trimming, resident memory grows for hours.
            self._trimmed_s = now_s
            return_freed_memory()

    def _hash(self, shown: ShownPicture) -> None:
        if self.report:
            self._digest.add(shown.rendered)

    def _take(self, prediction: Prediction | None) -> None:
        """Score the prediction of a frame, and keep the score until the frame is scored if it is not scored yet."""
        value = prediction_db(prediction)
        if prediction is None or not math.isfinite(value):
            return
        before_db = self._waiting_db.pop(prediction.frame.seq, None)
        if before_db is not None:
            self.next_frame.add(value, before_db)
        else:
            _keep(self._predicted, prediction.frame.seq, value)

    def _score_own(self, rendered: RenderedFrame) -> ScoredFrame:
        """Score a frame against its own picture."""
        tracker = self.trained if rendered.trained else self.held_out
        scored = self._score(rendered.frame, rendered, tracker, similarity=True)
        self._log(scored.as_json())
        return scored

    def _score_shown(self, frame: Frame, shown: ShownPicture | None, until_ns: float) -> ScoredFrame | None:
        """Score a frame against the picture on display until `until_ns`; None without a picture."""
        if shown is None:
            self._follow(frame)
            return None
        if self._first_s is None:
            self._first_s = frame.time_s
        similarity = self.report and self.frames % SIMILARITY_EVERY == 0
        scored = self._score(frame, shown.rendered, self.trained, similarity=similarity)
        self.not_on_screen += shown.rendered.frame.seq != frame.seq
        value = scored.quality.psnr_tissue_db
        if self._is_settled(frame):
            self.settled.add(value)
            self.before.add(scored.previous_frame_db)
            if math.isfinite(value) and (self.worst is None or value < self.worst[0]):
                self.worst = value, frame.seq
        self._log(_entry(scored, frame, shown, until_ns))
        return scored

    def _score(
        self, frame: Frame, rendered: RenderedFrame, tracker: QualityTracker, *, similarity: bool
    ) -> ScoredFrame:
        """Score a frame against a picture; `similarity` also computes SSIM."""
        previous = self._previous
        self._follow(frame)
        self.frames += 1
        quality, before_db = FrameQuality(frame.seq, math.nan, math.nan, math.nan), math.nan
        if frame.unusable is None:
            quality = tracker.observe(frame.seq, rendered.image, frame.image, frame.tissue, similarity=similarity)
            if previous is not None and previous.image.shape == frame.image.shape:
                before_db = psnr_tissue_db(previous.image, frame.image, frame.tissue)
        self.before_all.add(before_db)
        if tracker is self.held_out:
            self.before_held_out.add(before_db)
            if previous is not None and math.isfinite(before_db):
                self._without_next = previous, frame, quality.psnr_tissue_db
        return ScoredFrame(rendered, quality, before_db, self._next_frame_db(frame, before_db))

    def _follow(self, frame: Frame) -> None:
        if not frame.can_be_shown:
            return
        if self._without_next is not None:
            before, held_out, own_db = self._without_next
            self._without_next = None
            if frame.image.shape == held_out.image.shape:
                mean = (before.image.astype(np.float32) + frame.image) / np.float32(2 * 255)
                self.neighbour_mean.add(psnr_tissue_db(mean, held_out.image, held_out.tissue))
                self.between.add(own_db)
        self._previous = frame

    def _between_neighbours(self) -> BetweenNeighbours | None:
        own_db, mean_db = self.between.mean, self.neighbour_mean.mean
        if own_db is None or mean_db is None:
            return None
        return BetweenNeighbours(own_db, mean_db, self.between.count)

    def _log(self, entry: Mapping[str, Value]) -> None:
        if self.log is not None and self._log_works:
            # Do not write again in `stop` after a failed write, so that the error is reported once.
            self._log_works = False
            self.log.write(entry)
            self._log_works = True

    def _is_settled(self, frame: Frame) -> bool:
        if not self.on_screen:
            return True
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
        if self.report:
            entries, per_entry = self.log.series(self.frames) if self.log is not None else ((), 1)
            if self.log is not None and self.frames:
                outcome.output("frames", self.log.path)
            outcome.add(
                QualityResult(
                    self.trained,
                    self.held_out,
                    entries,
                    per_entry,
                    self.frames_sha256,
                    self.frames,
                    previous_frame_db=self.before_all.mean,
                    heldout_previous_frame_db=self.before_held_out.mean,
                    heldout_between=self._between_neighbours(),
                )
            )
        outcome.add(self.next_frame.result)
        if self.on_screen:
            worst_db, worst_seq = self.worst or (None, None)
            outcome.add(
                OnScreenResult(
                    settled_db=self.settled.mean,
                    worst_db=worst_db,
                    worst_seq=worst_seq,
                    previous_frame_db=self.before.mean,
                    frames=self.frames,
                    not_on_screen=self.not_on_screen,
                    unscored=self._screen.unscored,
                )
            )


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


@dataclass(frozen=True)
class ShownComparison:
    """Counts of replayed pictures that match or differ from the recorded ones."""

    same: int
    """Number of replayed pictures whose SHA-256 equals that of the recorded picture."""
    different: int
    first_different: int | None
    """Sequence number of the first frame whose picture differs; None if all match."""
    not_shown: int
    """Replayed pictures without a recorded counterpart: the session dropped their frames before display."""


class CompareShownOp(Operator):
    """Compares the SHA-256 of each replayed picture with the recorded one.

    Inputs:
        rendered: `RenderedFrame`, in order of the sequence number.

    Params:
        shown: factory called in `start()`; yields the log lines of the recorded pictures, ordered by sequence number.
    """

    def __init__(self, fragment: Any, *args: Any, shown: Callable[[], Iterator[ShownLine]], **kwargs: Any) -> None:
        self.shown = shown
        self._lines: Iterator[ShownLine] = iter(())
        self._due: ShownLine | None = None
        self.result = ShownComparison(0, 0, None, 0)
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)

    def start(self) -> None:
        self._lines = self.shown()
        self._due = next(self._lines, None)
        self.result = ShownComparison(0, 0, None, 0)

    def stop(self) -> None:
        self._lines = iter(())

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        rendered: RenderedFrame = op_input.receive("rendered")
        seq, before = rendered.frame.seq, self.result
        while self._due is not None and self._due.seq < seq:
            self._due = next(self._lines, None)
        same, different, first = before.same, before.different, before.first_different
        if self._due is None or self._due.seq != seq:
            self.result = ShownComparison(same, different, first, before.not_shown + 1)
            return
        if hashlib.sha256(np.ascontiguousarray(rendered.image).data).hexdigest() == self._due.sha256:
            same += 1
        else:
            different, first = different + 1, seq if first is None else first
        self.result = ShownComparison(same, different, first, before.not_shown)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        result = self.result
        outcome.add(result)
        if result.different:
            outcome.note(
                f"{result.different} of {result.same + result.different} pictures are not those that the session showed, the first of "
                f"frame {result.first_different}: replay gives the same ones on the same device, processor and versions"
            )
        elif result.same:
            outcome.note(f"all {result.same} pictures of the session were reproduced byte for byte")
