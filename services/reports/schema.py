"""Schema of `report.json`: one model for writing, reading and the JSON schema.

While `format_version` is unchanged, fields are only added. A missing measurement is null, never NaN.

Facts about the machine of the measurement.
"""

from __future__ import annotations

import json
import platform
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field

from gsplat_core.choices import Eyes
from gsplat_core.io.files import read_regular
from gsplat_core.machine import usable_cores
from gsplat_core.ops.native import instruction_set
from operators.sources.source import SourceDescription
from operators.storage import write_whole

MOST_REPORT_BYTES = 256 << 20

NOTICE = "Research use only, not a medical device."
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0)]


class Part(BaseModel):
    """Base class of the report's parts."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RecordingFacts(Part):
    """Source of the run: name, frame size, rate and number of frames, after `--scale` and `--max-frames`."""

    name: str
    frames: Count | None
    """Number of frames of the recording; null for an endless stream."""
    width_px: Annotated[int, Field(ge=1)]
    height_px: Annotated[int, Field(ge=1)]
    fps: Annotated[float, Field(gt=0)]
    digest: str | None = None
    """SHA-256 over the recording's files; null for other sources."""

    @classmethod
    def of(cls, description: SourceDescription) -> RecordingFacts:
        """Return the facts of a source's description."""
        return cls(
            name=description.name,
            frames=description.frame_count,
            width_px=description.width_px,
            height_px=description.height_px,
            fps=description.fps,
            digest=description.digest,
        )


class TrialFacts(Part):
    """Training that was scored by frames kept from it."""

    steps: Annotated[int, Field(ge=1)]
    psnr_tissue_db: float | None
    setup_s: float | None = None
    """Time before the first step, in seconds."""
    seconds: float | None = None
    """Duration of the training and its validation in seconds, without `setup_s`."""


class TrainingSteps(Part):
    """Number of steps of an offline training."""

    steps: Annotated[int, Field(ge=1)]
    reason: str
    """`given`, or the reason of the automatic choice: `best` of the trials, `limit` (the time limit ended the search),
    `most` (the largest number tried) or `few frames`. `interrupted` after a stop request during training: the model has had
    `steps` steps."""
    trials: list[TrialFacts] = []


class RunFacts(Part):
    """Settings and outcome of the run."""

    device: str
    engine: str
    seed: int
    version: str
    threads: Annotated[int, Field(ge=1)]
    wall_s: Annotated[float, Field(ge=0)]
    command: str = "replay"
    """`replay` or `reconstruct`, or another application that writes this report."""
    field: str
    """Name of the deformation field in use, never `auto`."""
    renderer: str = "alpha"
    steps_per_frame: int | None = None
    training_steps: TrainingSteps | None = None
    """Steps of an offline training; null for other runs."""
    eyes: Eyes = "left"
    """Pictures of a stereo endoscope used for training."""
    scale: float = 1.0
    started_at: str
    """Start time, UTC, ISO 8601."""
    stop_reason: str
    """Reason for the end: `end of recording`, `end of stream`, `end of the time asked for`, `interrupted`, or the
    failure."""
    interrupted: bool = False
    peak_memory_bytes: Count | None = None
    machine: dict[str, str] = {}
    """Processor, instruction set, operating system, versions of Python and torch."""


class FrameCounts(Part):
    ingested: Count
    displayed: Count
    dropped: Count
    damaged: Count = 0
    """Ingested frames repaired, concealed or skipped by the decoder; displayed, but neither trained on nor scored."""


class Latency(Part):
    """Milliseconds from a root operator's emission to the end of a leaf operator's work on it."""

    p50: float
    p95: float
    p99: float
    max: float


class OperatorTimes(Part):
    """Number and durations of an operator's runs."""

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
    """Prediction scores: each frame is rendered at its time and pose and scored before the model is trained on it.
    Scores are in dB.
    """

    psnr_tissue_db: float | None
    """Mean tissue PSNR of the predictions. In a live run: after the first second, of every fourth
    (GPU) or eighth (CPU) picture."""
    previous_frame_db: float | None
    """Trivial baseline: mean tissue PSNR of the previous raw frame over the same frames."""
    frames: Count


class BaselineQuality(Part):
    """Tissue PSNR in dB of trivial baselines on the same recording; null if not measured."""

    previous_frame_db: float | None
    """Previous raw frame, over the scored frames and their tissue."""
    train_mean_db: float | None = None
    """Mean of all training frames, for every held-out frame; null except in older reports (`evaluate` measures it)."""
    heldout_previous_frame_db: float | None = None
    heldout_neighbour_mean_db: float | None = None
    """Tissue PSNR in dB of the mean of the previous and the next frame, over the frames of `heldout_between`. Uses a future
    frame."""


class DepthErrors(Part):
    """Root mean squared depth error over all compared pixels, as a share of the median true depth."""

    reconstruction: float
    level_plane: float
    """Baseline with ground truth: each frame's median true depth everywhere."""
    best_plane: float
    """Baseline with ground truth: each frame's best tilted plane."""
    frames: Count


class TruthFacts(Part):
    """Scores against the ground truth of a synthetic recording; null where the recording has none."""

    behind_tools_psnr_db: float | None
    """PSNR in dB over pixels that are behind a tool and were visible in an earlier frame, against the true picture
    without the tool."""
    last_seen_psnr_db: float | None
    """Trivial baseline of `behind_tools_psnr_db`: each pixel with its last visible value."""
    inpainted_psnr_db: float | None
    """Trivial baseline of `behind_tools_psnr_db`: the frame's own picture, inpainted from the tool's surroundings."""
    frames: Count
    """Number of frames scored behind their tools."""
    depth: DepthErrors | None
    """Errors over tissue visible to the camera."""
    depth_behind_tools: DepthErrors | None
    """Errors over tissue behind tools that was seen earlier."""


class BetweenQuality(Part):
    psnr_tissue_db: float
    frames: Count


class QualityReport(Part):
    live: Quality | None
    """Training error: each displayed frame right after training on it. Null for an offline reconstruction."""
    next_frame: NextFrameQuality | None = None
    """Prediction score, which is no training error. Null for an offline reconstruction and in older reports."""
    heldout: Quality | None
    """Scores of frames without training; null without `--heldout`."""
    heldout_between: BetweenQuality | None = None
    """Scores of the held-out frames that have a previous and a next frame, to compare with
    `baselines.heldout_neighbour_mean_db`; null if there are none, and in older reports."""
    baselines: BaselineQuality
    truth: TruthFacts | None = None
    """Scores against ground truth. Null if the recording has none of depth or of the tissue behind its tools."""
    training: Quality | None = None
    """Training error of an offline reconstruction: training frames after all training. Null for a replay."""


class ModelFacts(Part):
    gaussians: Count
    parameters: Count
    sha256: Sha256
    version: Count


class LiveFacts(Part):
    """Throughput, scores and picture ages of a live run; scores are null if no frame was scored."""

    settled_psnr_tissue_db: float | None
    """Training error: mean tissue PSNR in dB after the first second, of the picture displayed when the next frame came."""
    worst_psnr_tissue_db: float | None
    """Lowest tissue PSNR of a frame after the first second, in dB."""
    previous_frame_db: float | None
    """Trivial baseline: mean tissue PSNR in dB of the previous raw frame, after the first second."""
    pictures: Count
    """Number of new pictures displayed."""
    age_p50_ms: float
    """Median age of new pictures at display, in milliseconds."""
    age_p95_ms: float
    age_p99_ms: float
    age_max_ms: float
    settled_age_p99_ms: float | None = None
    """99th percentile of the age of new pictures at display after the first second, in milliseconds; None in older
    reports and shorter runs.
    """
    used_age_p99_ms: float | None = None
    """`settled_age_p99_ms` without pictures of withheld and damaged frames, which show the content of an earlier frame."""
    first_picture_ms: float | None
    states: dict[str, Count]
    """Number of transitions into each display state."""
    dropped: dict[str, Count]
    """Number of frames, pictures and scores dropped in favour of newer ones, by graph edge or operator."""
    withheld: dict[str, Count]
    """Number of withheld and damaged frames, by reason. Blurred frames and possible cuts may be trained on nevertheless."""
    scenes: dict[str, Count]
    """Number of scene changes, by reason."""
    analysis: dict[str, dict[str, Count]] = {}
    """Findings of the frame analysis before training, by stage and reason."""
    frames_trained: Count
    steps: Count
    """Optimiser steps on the newest frame, before its display."""
    rehearsed_steps: Count
    """Optimiser steps on earlier frames."""
    unscored: Count
    not_on_screen: Count
    """Frames whose own picture was not displayed when the next frame arrived."""


class FrameEntry(Part):
    """Scores of one displayed frame; null where it has none."""

    seq: Count
    time_s: float
    trained: bool
    model_version: Count
    psnr_tissue_db: float | None
    """Tissue PSNR in dB of the displayed picture; a training error if the frame was `trained` on."""
    psnr_frame_db: float | None
    ssim: float | None
    previous_frame_db: float | None
    """Trivial baseline: tissue PSNR in dB of the previous raw frame."""
    next_frame_db: float | None = None
    """Tissue PSNR in dB of the model's prediction of this frame before training on it."""
    age_ms: float | None = None
    """Age of the displayed picture at display, in milliseconds; null except in live runs."""
    steps: Count | None = None
    """Number of optimiser steps on the frame of the displayed picture, which may be an older frame; as `age_ms`."""


class BinEntry(FrameEntry):
    """Summary of several displayed frames of a long run: `seq`, `time_s` and `model_version` of the
    first, means of the measures."""

    frames: Count
    """Number of summarised frames."""
    psnr_tissue_min_db: float | None
    """Lowest `psnr_tissue_db` of the summarised frames."""


class RunReport(Part):
    """Content of `report.json`."""

    format_version: Literal[1] = 1
    notice: str = NOTICE
    recording: RecordingFacts
    run: RunFacts
    frames: FrameCounts
    latency_ms: dict[str, Latency]
    operators: dict[str, OperatorTimes]
    quality: QualityReport
    model: ModelFacts | None
    """Facts about the final model. Null if the run ended before the first snapshot."""
    live: LiveFacts | None = None
    """Throughput and picture ages of a live run; null for other runs."""
    frames_sha256: Sha256
    notes: list[str] = []
    """Sentences about fallbacks and problems."""
    outputs: dict[str, str] = {}
    """Written files, as paths relative to the report."""
    latency_quantiles_ms: dict[str, list[float]] = {}
    """Latency distribution per path at 101 equally spaced quantiles, 0 to 1."""
    series: list[FrameEntry | BinEntry] = []
    """One entry per displayed frame. Above 4096 frames, one per `series_frames_per_entry` frames.
    `frames.jsonl` has all frames."""
    series_frames_per_entry: Annotated[int, Field(ge=1)] = 1

    def write(self, path: Path) -> None:
        """Write JSON atomically."""
        text = json.dumps(self.model_dump(mode="json"), indent=2, allow_nan=False)
        write_whole(path, (text + "\n").encode())

    @classmethod
    def read(cls, path: Path) -> RunReport:
        """Read a report.

        Raises:
            pydantic.ValidationError: if the content does not match the schema.
            OSError: if the path is no regular file of at most MOST_REPORT_BYTES.
        """
        return cls.model_validate_json(read_regular(path, MOST_REPORT_BYTES))


def machine_facts() -> dict[str, str]:
    """Return names and values of the facts, formatted for people."""
    return {
        "Processor": f"{processor_name()}, {usable_cores()} cores",
        "Instruction set": instruction_set(),
        "System": f"{platform.system()} {platform.release()}",
        "Python": platform.python_version(),
        "torch": torch.__version__,
    }


def processor_name() -> str:
    """Return the processor's marketing name if the system reports it, else its architecture."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except FileNotFoundError:
        pass
    return platform.processor() or platform.machine()
