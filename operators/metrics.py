"""Quality scores of displayed frames with trivial baselines, and a digest of the displayed
bytes.
"""

from __future__ import annotations

import hashlib
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import FrameQuality, QualityTracker, ScoredMean, psnr_tissue_db
from operators.frame_log import Entry, FrameLog
from operators.graph import Operator, OperatorSpec
from operators.messages import Prediction, RenderedFrame
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

    def as_json(self) -> Entry:
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
        """Add the PSNR values of one frame, in dB. Ignored if either is not finite."""
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
    series: tuple[Entry, ...]
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
