"""How good each displayed frame is, and which bytes were displayed."""

from __future__ import annotations

import hashlib
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import FrameQuality, QualityTracker, psnr_tissue_db
from operators.frame_log import Entry, FrameLog
from operators.graph import Operator, OperatorSpec
from operators.messages import RenderedFrame
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class ScoredFrame:
    """A displayed frame and its quality."""

    rendered: RenderedFrame
    quality: FrameQuality
    previous_frame_db: float
    """Tissue PSNR of showing the raw frame before it instead: what doing nothing scores. NaN for the first frame."""

    def as_json(self) -> Entry:
        """One entry of the report's series; null where a measure does not exist."""
        frame = self.rendered.frame
        measures = {
            "psnr_tissue_db": self.quality.psnr_tissue_db,
            "psnr_frame_db": self.quality.psnr_frame_db,
            "ssim": self.quality.ssim,
            "previous_frame_db": self.previous_frame_db,
        }
        return {
            "seq": frame.seq,
            "time_s": frame.time_s,
            "trained": self.rendered.trained,
            "model_version": self.rendered.model_version,
            **{name: value if math.isfinite(value) else None for name, value in measures.items()},
        }


@dataclass(frozen=True)
class QualityResult:
    """How good a run's frames were."""

    trained: QualityTracker
    """Frames that were trained on before they were shown."""
    held_out: QualityTracker
    """Frames that were shown and never trained on."""
    series: tuple[Entry, ...]
    """One entry per displayed frame, in order; of a long run, one per bin of frames (see `frame_log.series`)."""
    frames_per_entry: int
    frames_sha256: str
    frames: int
    """How many frames were displayed; damaged ones are among them, and are not scored."""


class MetricsOp(Operator):
    """Scores each displayed frame against its raw frame, over tissue, and takes a digest of the bytes that were displayed.

    The digest is SHA-256 over, for each frame in order, the line `seq width height\\n` and the RGB bytes of the reconstruction.
    In memory only means are kept; each frame's own figures go to the log. A damaged frame is part of the digest and of the log, without
    figures: a reconstruction is not measured against what the decoder guessed.

    Inputs:
        rendered: `RenderedFrame`.

    Outputs:
        scored: `ScoredFrame`.

    Params:
        log: where each frame's figures are written; without one there is no series.
    """

    def __init__(self, fragment: Any, *args: Any, log: FrameLog | None = None, **kwargs: Any) -> None:
        self.log = log
        self.live = QualityTracker()
        """Frames that were trained on before they were shown."""
        self.held_out = QualityTracker()
        """Frames that were shown and never trained on."""
        self.frames = 0
        """How many frames arrived so far."""
        self._digest = hashlib.sha256()
        self._hashing = ThreadPoolExecutor(1, thread_name_prefix="hash frames")
        self._previous: Frame | None = None
        super().__init__(fragment, *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("rendered", type=RenderedFrame)
        spec.output("scored", type=ScoredFrame)

    def start(self) -> None:
        self.live, self.held_out, self.frames = QualityTracker(), QualityTracker(), 0
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
        # Beside the scoring: neither keeps the interpreter's lock for long.
        hashed = self._hashing.submit(self._digest.update, np.ascontiguousarray(rendered.image).data)
        self.frames += 1
        quality, before_db = FrameQuality(frame.seq, math.nan, math.nan, math.nan), math.nan
        if frame.status is not FrameStatus.DAMAGED:
            tracker = self.live if rendered.trained else self.held_out
            quality = tracker.observe(frame.seq, rendered.image, frame.image, frame.mask)
            if previous is not None and previous.image.shape == frame.image.shape:
                before_db = psnr_tissue_db(previous.image, frame.image, frame.mask)
        hashed.result()
        scored = ScoredFrame(rendered, quality, before_db)
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

    @property
    def frames_sha256(self) -> str:
        """The digest so far, in hex."""
        return self._digest.hexdigest()
