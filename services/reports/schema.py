"""The shape of `report.json`: one model that writes it, reads it back and gives its JSON schema.

Fields are added, never renamed or removed, as long as `format_version` stays. A measure that does not exist is null, never NaN.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from gsplat_core.io.files import read_regular
from operators.storage import write_whole

MOST_REPORT_BYTES = 256 << 20

NOTICE = "Research use only, not a medical device."
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0)]


class Part(BaseModel):
    """A part of a report."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RecordingFacts(Part):
    """The recording as it was read: after `--scale` and `--max-frames`."""

    name: str
    frames: Count | None
    """Null for a stream without an end."""
    width_px: Annotated[int, Field(ge=1)]
    height_px: Annotated[int, Field(ge=1)]
    fps: Annotated[float, Field(gt=0)]
    digest: str | None = None
    """SHA-256 over the recording's files."""


class RunFacts(Part):
    """How the run was made, and how it ended."""

    device: str
    engine: str
    seed: int
    version: str
    threads: Annotated[int, Field(ge=1)]
    wall_s: Annotated[float, Field(ge=0)]
    command: str = "replay"
    """`replay` or `reconstruct`, or another application that writes such a report."""
    field: str
    """Deformation field in use: `basis` or `hexplane`, never `auto`."""
    renderer: str = "alpha"
    steps_per_frame: int | None = None
    eyes: Literal["left", "both"] = "left"
    """Which pictures of a stereo scope the model was trained on."""
    scale: float = 1.0
    started_at: str
    """UTC, ISO 8601."""
    stop_reason: str
    """Why the run ended: `end of recording`, `interrupted`, or what failed."""
    interrupted: bool = False
    peak_memory_bytes: Count | None = None
    machine: dict[str, str] = {}
    """Processor, instruction set, versions of Python and torch."""


class FrameCounts(Part):
    ingested: Count
    displayed: Count
    dropped: Count
    damaged: Count = 0
    """Of the ingested ones: repaired, guessed or skipped by the decoder; shown, neither trained on nor scored."""


class Latency(Part):
    """Milliseconds from a root operator's emission to the end of a leaf operator's work on it."""

    p50: float
    p95: float
    p99: float
    max: float


class OperatorTimes(Part):
    """How often an operator ran and how long a run of it took."""

    calls: Count
    p50_ms: float
    p99_ms: float


class Quality(Part):
    """Means over frames; PSNR is averaged in decibels."""

    psnr_tissue_db: float | None
    psnr_frame_db: float | None
    ssim: float | None
    frames: Count


class NextFrameQuality(Part):
    """Each frame predicted by the model that had not been trained on it: rendered at the frame's time and pose, and scored before training."""

    psnr_tissue_db: float | None
    """Mean tissue PSNR of the predictions. Of a live run: after the first second, of every fourth (GPU) or eighth (CPU) picture."""
    previous_frame_db: float | None
    """Mean tissue PSNR of the previous raw frame over the same frames: the trivial prediction."""
    frames: Count


class BaselineQuality(Part):
    """Tissue PSNR of doing nothing, on the same recording."""

    previous_frame_db: float | None
    """The raw frame before, shown for every frame from the second on."""
    train_mean_db: float | None
    """The mean of all training frames, shown for every held-out frame."""
    heldout_previous_frame_db: float | None = None
    heldout_neighbour_mean_db: float | None = None
    """Mean of the frames before and after; it sees the future."""


class DepthErrors(Part):
    """Root mean squared error of depth over the median true depth, of all compared pixels."""

    reconstruction: float
    level_plane: float
    """Each frame's median true depth, shown everywhere: a trivial baseline that knows the truth."""
    best_plane: float
    """Each frame's best tilted plane: a trivial baseline that knows the truth."""
    frames: Count


class TruthFacts(Part):
    """What the camera does not show, against the truth of a synthetic recording."""

    behind_tools_psnr_db: float | None
    """Over pixels behind a tool whose place was seen before, against the picture through the tool."""
    last_seen_psnr_db: float | None
    """Trivial baseline: each of these pixels as it was seen last."""
    inpainted_psnr_db: float | None
    """Trivial baseline: the frame's own picture, filled in from around the tool."""
    frames: Count
    """Frames that were scored behind their tools."""
    depth: DepthErrors | None
    """Of tissue that the camera shows."""
    depth_behind_tools: DepthErrors | None
    """Of tissue behind tools that was seen before."""


class QualityReport(Part):
    live: Quality | None
    """Training error: each displayed frame right after the model was trained on it. Null for an offline reconstruction."""
    next_frame: NextFrameQuality | None = None
    """The figure that is no training error. Null for an offline reconstruction, and in reports of earlier versions."""
    heldout: Quality | None
    """Frames that were never trained on; null without `--heldout`."""
    baselines: BaselineQuality
    truth: TruthFacts | None = None
    """Null where the recording does not know what is behind its tools."""
    training: Quality | None = None
    """Training error of an offline reconstruction: training frames after all of the training. Null for a replay."""


class ModelFacts(Part):
    gaussians: Count
    parameters: Count
    sha256: Sha256
    version: Count


class LiveFacts(Part):
    """What a live run kept up with, and how old its pictures were."""

    settled_psnr_tissue_db: float | None
    """Training error: mean after the first second, of what was on the screen when the next frame arrived."""
    worst_psnr_tissue_db: float | None
    """The lowest of these."""
    previous_frame_db: float | None
    """Mean after the first second of the raw frame before, shown instead."""
    pictures: Count
    """New pictures that were shown."""
    age_p50_ms: float
    """From a frame's arrival to its picture."""
    age_p95_ms: float
    age_p99_ms: float
    age_max_ms: float
    first_picture_ms: float | None
    states: dict[str, Count]
    """How often what was shown went over into each state."""
    dropped: dict[str, Count]
    """Frames, pictures and figures that gave way to newer ones, by the edge of the graph, or the operator, where they did."""
    withheld: dict[str, Count]
    """Frames that were shown and not trained on, by reason."""
    scenes: dict[str, Count]
    """How often a new scene began, by reason."""
    analysis: dict[str, dict[str, Count]] = {}
    """What was found on frames before they were learned from: by stage and reason."""
    frames_trained: Count
    steps: Count
    """Optimiser steps on the newest frame, before it was shown."""
    rehearsed_steps: Count
    """Optimiser steps on earlier frames."""
    unscored: Count
    not_on_screen: Count
    """Frames whose own picture was not on the screen when the next frame arrived."""


class FrameEntry(Part):
    """One displayed frame."""

    seq: Count
    time_s: float
    trained: bool
    model_version: Count
    psnr_tissue_db: float | None
    """Of the displayed picture; a training error where the frame was `trained` on."""
    psnr_frame_db: float | None
    ssim: float | None
    previous_frame_db: float | None
    """Of the previous raw frame, shown instead."""
    next_frame_db: float | None = None
    """Of the picture that the model gave of this frame before it was trained on it; null where there is none."""
    age_ms: float | None = None
    """Live: age of what was on the screen, when it came there."""
    steps: Count | None = None
    """Live: optimiser steps before the picture was shown."""


class BinEntry(FrameEntry):
    """Several displayed frames of a long run, summed up: `seq`, `time_s` and `model_version` of the first of them, means of the measures."""

    frames: Count
    """How many frames are summed up."""
    psnr_tissue_min_db: float | None
    """The worst of them."""


class RunReport(Part):
    """Everything `report.json` holds."""

    format_version: Literal[1] = 1
    notice: str = NOTICE
    recording: RecordingFacts
    run: RunFacts
    frames: FrameCounts
    latency_ms: dict[str, Latency]
    operators: dict[str, OperatorTimes]
    quality: QualityReport
    model: ModelFacts | None
    """Null when the run ended before the first snapshot."""
    live: LiveFacts | None = None
    """Null for a run that follows no clock."""
    frames_sha256: Sha256
    notes: list[str] = []
    """Stated fallbacks and what went wrong, in sentences."""
    outputs: dict[str, str] = {}
    """What was written, as paths relative to the report."""
    latency_quantiles_ms: dict[str, list[float]] = {}
    """Per path, the latency distribution at 101 equally spaced quantiles, 0 to 1."""
    series: list[FrameEntry | BinEntry] = []
    """One entry for each displayed frame; of a run of more than 4096 frames, one for each `series_frames_per_entry` of them. All frames are
    in `frames.jsonl`."""
    series_frames_per_entry: Annotated[int, Field(ge=1)] = 1

    def write(self, path: Path) -> None:
        """Write JSON; the file is whole or not there."""
        text = json.dumps(self.model_dump(mode="json"), indent=2, allow_nan=False)
        write_whole(path, (text + "\n").encode())

    @classmethod
    def read(cls, path: Path) -> RunReport:
        """Read a report back. Raises pydantic.ValidationError where it does not fit, OSError for anything but a plain file of at most MOST_REPORT_BYTES."""
        return cls.model_validate_json(read_regular(path, MOST_REPORT_BYTES))
