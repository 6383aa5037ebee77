"""Reports of evaluations: the schema of `evaluation.json`, the model or run that is evaluated, and the conversion of its measurements to a report."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from gsplat_core.errors import InvalidSetting
from gsplat_core.evaluation.baselines import (
    HALF_VELOCITY,
    HALF_WAY,
    NEIGHBOUR_MEAN,
    PREVIOUS_FRAME,
    SEES_THE_FUTURE,
    TRAIN_MEAN,
)
from gsplat_core.evaluation.protocols import PlaceScore
from gsplat_core.evaluation.scores import BaselineScore, Live
from gsplat_core.evaluation.views import MATCHED, RIGHT_BEFORE, SHIFTED, SecondEye
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.files import read_regular
from gsplat_core.models import Model
from operators.applications.evaluate import Evaluation, EvaluationSettings
from operators.applications.evaluated import EvaluatedRun
from operators.frame_log import MAX_SERIES, LogLine, frames_per_entry, read_frames, series
from operators.storage import write_whole
from services import product_version
from services.reports.schema import (
    MOST_REPORT_BYTES,
    NOTICE,
    Count,
    ModelFacts,
    Part,
    RecordingFacts,
    RunReport,
    machine_facts,
)

Decibels = float | None
Seconds = tuple[float, float]
"""First and last time of a range in seconds."""


class ScoreFacts(Part):
    """Means over frames; PSNR is averaged in decibels."""

    psnr_tissue_db: Decibels
    psnr_frame_db: Decibels
    ssim: float | None
    frames: Count
    worst_db: Decibels
    worst_seq: int | None
    left_out: dict[str, Count]
    """Number of frames without a score, by reason."""


class BaselineFacts(Part):
    """Scores of one trivial baseline on the same recording."""

    name: str
    label: str
    frames_of: Literal["every", "heldout", "last", "live", "settled", "second_eye"]
    """Frames with a score: every available frame, held-out frames, the last seconds, the frames of
    the live or settled scores, or the frames with a scored right view."""
    psnr_tissue_db: Decibels
    psnr_frame_db: Decibels
    frames: Count
    age_frames: int | None = None
    """For the frame-hold baselines: age in frames of the raw frame that is displayed again; null for other
    baselines."""
    psnr_both_db: Decibels = None
    """For the frame-hold baselines: PSNR in dB over pixels that are tissue in both the old and the current frame."""
    sees_future: bool = False
    """True if the baseline uses the next frame, which a live system does not have."""


class DepthFacts(Part):
    mae_mm: float
    rmse_mm: float
    relative: float
    scaled_rmse_mm: float
    covered: float
    frames: Count


class HeldOutFacts(Part):
    score: ScoreFacts
    unrounded_db: Decibels
    """Mean tissue PSNR before rounding to 8 bits."""
    depth: DepthFacts | None


class CausalFacts(Part):
    score: ScoreFacts
    field: str
    steps_per_frame: int
    seed: int
    motion_prior: str


class AgeFacts(Part):
    count: Count
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class OnScreenFacts(Part):
    score: ScoreFacts
    settled: ScoreFacts
    """Scores without the first second of the run, in which the model is still being initialised."""
    age_when_shown: AgeFacts | None
    age_on_screen: AgeFacts | None
    in_time: Count
    behind: dict[int, Count]
    states: dict[str, Count]


class PlaceFacts(Part):
    first_s: Seconds
    again_s: Seconds
    first: ScoreFacts
    again: ScoreFacts


class RetentionFacts(Part):
    last: ScoreFacts
    last_range_s: Seconds
    places: list[PlaceFacts]


class DepthShareFacts(Part):
    """Depth errors over all compared frames, as shares of the median true depth."""

    rmse_share: float
    scaled_rmse_share: float
    """`rmse_share` after scaling the model's depth by `scale`, which assesses its shape only."""
    plane_rmse_share: float
    """`rmse_share` of a baseline: each frame's best-fit plane."""
    level_rmse_share: float
    """`rmse_share` of a baseline: a level plane at each frame's median true depth."""
    median_share: float
    rmse: float
    """Root mean square error in the unit of the recording's depth, mm if calibrated."""
    scale: float
    median_depth: float
    covered: float
    frames: Count


class NormalFacts(Part):
    mean_deg: float
    median_deg: float
    plane_mean_deg: float
    level_mean_deg: float | None = None
    """Baseline: mean normal error of a plane perpendicular to the optical axis. None in older reports."""
    frames: Count


class ViewFacts(Part):
    """Scores of a camera that training did not use, over the tissue pixels that the training camera saw."""

    name: str
    model: ScoreFacts
    left: ScoreFacts
    """Baseline: unchanged left picture."""
    shifted: ScoreFacts
    """Baseline: left picture reprojected as if all tissue were at its median distance."""
    seen: float


class TrackFacts(Part):
    median_mm: float
    mean_mm: float
    median_px: float
    mean_px: float
    within_mm: float
    within_px: float


class TrackingFacts(Part):
    """Tracking errors of tissue points, in left camera coordinates and in pixels of the evaluated pictures."""

    model: TrackFacts
    scaled: TrackFacts
    """Errors after scaling the model by the sequence's depth scale factor."""
    still: TrackFacts
    """Errors of a baseline without motion."""
    points: Count
    compared: Count


class EndPointFacts(Part):
    median_px: float
    mean_px: float
    median_mm: float | None
    """Median end-point error of the scene flow in mm. Null if the recording has no scene flow."""
    mean_mm: float | None


class FlowFacts(Part):
    """End-point errors of the flow to the next frame, in the picture and in space."""

    model: EndPointFacts
    scaled: EndPointFacts
    """Errors after scaling the model by the sequence's depth scale factor."""
    still: EndPointFacts
    """Errors of a baseline without motion."""
    frames: Count


class TrajectoryFacts(Part):
    """Absolute trajectory error as a share of the true path length."""

    rigid_share: float
    similarity_share: float
    """Position error after the best alignment and scale, as a share of the length of the true path."""
    still_share: float
    rigid_rmse: float
    rotation_deg: float
    scale: float
    path: float
    frames: Count


class PartFacts(Part):
    """Shares of the frozen model's squared picture error that each part of the deformation removes (`PartShares`)."""

    motion: float
    colour: float
    size: float
    explained: float
    reference_s: float
    frames: Count


class GeometryFacts(Part):
    """3D accuracy of the model; null or empty without ground truth."""

    frames: Count
    depth: DepthShareFacts | None
    normals: NormalFacts | None
    views: list[ViewFacts]
    scaled_views: list[ViewFacts]
    """Scores of the views after scaling the model's depth by one factor for the sequence; they do not assess lengths.
    """
    tracking: TrackingFacts | None
    flow: FlowFacts | None = None
    trajectory: TrajectoryFacts | None
    parts: PartFacts | None
    ray_depth: DepthShareFacts | None = None
    """Depth along the rays; null if the renderer does not have it. `depth` is that of the Gaussians' centres."""
    ray_normals: NormalFacts | None = None


class SecondEyeFacts(Part):
    score: ScoreFacts
    """`psnr_tissue_db` after a linear fit per channel, over pixels visible to both eyes."""
    left_out_px: Count
    """Number of pixel columns at the right edge that are not scored, because only the right eye sees them."""


class ReturnFacts(Part):
    """Image quality after one return of the endoscope to a place seen before."""

    again_s: Seconds
    first_db: list[Decibels]
    frames_until_found: int | None


class EvaluatedFacts(Part):
    """Evaluated model and evaluation settings."""

    path: str
    """Path as given by the user."""
    command: str | None
    """Command that created the model; null if unknown."""
    model: ModelFacts
    time_window_s: Seconds
    scale: float
    device: str
    renderer: str
    version: str
    started_at: str
    wall_s: float
    interrupted: bool
    machine: dict[str, str]


class EvaluationReport(Part):
    """Content of `evaluation.json`; null for protocols without measurement."""

    format_version: Literal[1] = 1
    notice: str = NOTICE
    recording: RecordingFacts
    evaluated: EvaluatedFacts
    heldout: HeldOutFacts | None
    causal: CausalFacts | None
    live: OnScreenFacts | None
    retention: RetentionFacts | None
    geometry: GeometryFacts | None = None
    second_eye: SecondEyeFacts | None = None
    returns: dict[str, list[ReturnFacts]]
    """Image quality after each return to a place seen before, by evaluation protocol (`live`, `causal`)."""
    baselines: list[BaselineFacts]
    left_out: dict[str, Count]
    """Frames without a baseline score, by reason."""
    notes: list[str]
    outputs: dict[str, str]
    """Files written by the evaluation, as paths relative to the report."""
    series: dict[str, list[dict[str, float | int | bool | str | None]]]
    """Entries per scored frame, by protocol. Above 4096 frames, one entry per `series_frames_per_entry` frames."""
    series_frames_per_entry: dict[str, Annotated[int, Field(ge=1)]]

    def write(self, path: Path) -> None:
        """Write the report as a JSON file, atomically."""
        text = json.dumps(self.model_dump(mode="json"), indent=2, allow_nan=False)
        write_whole(path, (text + "\n").encode())

    @classmethod
    def read(cls, path: Path) -> EvaluationReport:
        """Read a report from its JSON file.

        Raises:
            pydantic.ValidationError: if the content does not match the schema.
            OSError: if the path is no regular file of at most MOST_REPORT_BYTES.
        """
        return cls.model_validate_json(read_regular(path, MOST_REPORT_BYTES))


REPORT, MODEL = "report.json", "model"


def load_evaluated(path: Path) -> tuple[Model, EvaluatedRun | None]:
    """Load the model at `path`, with the report of the run that created it. The report is in the
    run's folder, or next to the bundle if its digest matches.

    Returns:
        The model, and the run or None.

    Raises:
        InvalidSetting: if a run has no model, an unreadable report, or the report of another model.
        BundleError: if the model cannot be loaded.
    """
    if os.path.lexists(path / REPORT):
        report = _read(path / REPORT)
        if not (path / MODEL).is_dir():
            raise InvalidSetting(f"{path} is a run that left no model; give another run, or a model folder")
        model = load_bundle(path / MODEL)
        if report.model is not None and report.model.sha256 != model.sha256():
            raise InvalidSetting(
                f"{path / MODEL} is not the model that {path / REPORT} is about (SHA-256 {report.model.sha256[:12]}...); give the model's"
                " folder to evaluate it alone"
            )
        return model, _run(path, report)
    model = load_bundle(path)
    beside = path.absolute().parent / REPORT
    if path.absolute().name == MODEL and os.path.lexists(beside):
        report = _read(beside)
        if report.model is not None and report.model.sha256 == model.sha256():
            return model, _run(beside.parent, report)
    return model, None


def _read(path: Path) -> RunReport:
    try:
        return RunReport.read(path)
    except OSError as error:
        raise InvalidSetting(
            f"{path} cannot be read: {error.strerror or error}; give the model's folder to evaluate it alone"
        ) from error
    except (ValidationError, UnicodeDecodeError, RecursionError) as error:
        said = str(error).splitlines()
        raise InvalidSetting(
            f"{path} is not a report of this version ({' '.join(said[:2])}); give the model's folder to evaluate it alone"
        ) from error


def _run(folder: Path, report: RunReport) -> EvaluatedRun:
    run = report.run
    return EvaluatedRun(
        folder=folder,
        command=run.command,
        field=run.field,
        seed=run.seed,
        steps_per_frame=run.steps_per_frame,
        scale=run.scale,
        heldout=report.quality.heldout is not None,
        eyes=run.eyes,
        fps=report.recording.fps if run.command == "live" else None,
    )


LABELS = {
    PREVIOUS_FRAME: "Previous frame shown instead",
    NEIGHBOUR_MEAN: "Mean of both neighbours",
    HALF_WAY: "Half-way optical flow between the neighbours",
    TRAIN_MEAN: "Mean of all training frames",
    HALF_VELOCITY: "Half of a constant-velocity optical flow",
    SHIFTED: "Left picture shifted by the typical disparity",
    MATCHED: "Left picture warped by semi-global matching",
    RIGHT_BEFORE: "Right picture of the frame before",
}


def build_evaluation(
    path: Path, model: Model, run: EvaluatedRun | None, settings: EvaluationSettings, evaluation: Evaluation
) -> EvaluationReport:
    """Convert the evaluation of the model at `path` to a report."""
    per_entry = {name: frames_per_entry(_lines(log), MAX_SERIES) for name, log in evaluation.logs.items()}
    retention = evaluation.retention
    return EvaluationReport(
        recording=RecordingFacts.of(evaluation.description),
        evaluated=_evaluated(path, model, run, settings, evaluation),
        heldout=None if evaluation.heldout is None else HeldOutFacts.model_validate(asdict(evaluation.heldout)),
        causal=None if evaluation.causal is None else CausalFacts.model_validate(asdict(evaluation.causal)),
        live=None if evaluation.live is None else _live(evaluation.live),
        retention=None
        if retention is None
        else RetentionFacts(
            last=ScoreFacts.model_validate(asdict(retention.last)),
            last_range_s=retention.last_range_s,
            places=[_place(place) for place in retention.places],
        ),
        geometry=None if evaluation.geometry is None else GeometryFacts.model_validate(asdict(evaluation.geometry)),
        second_eye=None if evaluation.second_eye is None else _second_eye(evaluation.second_eye),
        returns={
            name: [
                ReturnFacts(
                    again_s=each.visits.again,
                    first_db=list(each.first_db),
                    frames_until_found=each.frames_until_found,
                )
                for each in found
            ]
            for name, found in evaluation.returns.items()
        },
        baselines=list(_baselines(evaluation)),
        left_out=dict(evaluation.baselines.left_out),
        notes=list(evaluation.notes),
        outputs={name: log.name for name, log in evaluation.logs.items()},
        series={name: _series(log, per_entry[name]) for name, log in evaluation.logs.items()},
        series_frames_per_entry=per_entry,
    )


def _evaluated(
    path: Path, model: Model, run: EvaluatedRun | None, settings: EvaluationSettings, evaluation: Evaluation
) -> EvaluatedFacts:
    return EvaluatedFacts(
        path=str(path),
        command=None if run is None else run.command,
        model=ModelFacts(
            gaussians=model.gaussians.count,
            parameters=model.parameter_count,
            sha256=model.sha256(),
            version=model.version,
        ),
        time_window_s=model.time_window_s,
        scale=evaluation.scale,
        device=settings.device,
        renderer=settings.renderer,
        version=product_version(),
        started_at=evaluation.started_at.isoformat(timespec="seconds"),
        wall_s=round(evaluation.wall_s, 3),
        interrupted=evaluation.interrupted,
        machine=machine_facts(),
    )


def _second_eye(found: SecondEye) -> SecondEyeFacts:
    return SecondEyeFacts(score=ScoreFacts.model_validate(asdict(found.score)), left_out_px=found.left_out_px)


def _live(live: Live) -> OnScreenFacts:
    facts = {name: value for name, value in asdict(live).items() if name in OnScreenFacts.model_fields}
    return OnScreenFacts.model_validate(facts)


def _place(place: PlaceScore) -> PlaceFacts:
    return PlaceFacts(
        first_s=place.visits.first,
        again_s=place.visits.again,
        first=ScoreFacts.model_validate(asdict(place.first)),
        again=ScoreFacts.model_validate(asdict(place.again)),
    )


def _baselines(evaluation: Evaluation) -> Iterator[BaselineFacts]:
    """Yield every measured baseline, those over all frames first."""
    measured = evaluation.baselines
    for age, score in measured.copies.items():
        label = LABELS[PREVIOUS_FRAME] if age == 1 else f"Frame shown {age} frames late"
        yield _baseline(PREVIOUS_FRAME if age == 1 else f"copy_{age}", label, "every", score, age)
    for name, score in measured.every.items():
        yield _baseline(name, LABELS[name], "every", score)
    for name in (PREVIOUS_FRAME, NEIGHBOUR_MEAN, HALF_WAY, TRAIN_MEAN):
        if name in measured.heldout:
            yield _baseline(name, LABELS[name], "heldout", measured.heldout[name])
    if evaluation.live is not None:
        yield _baseline(PREVIOUS_FRAME, LABELS[PREVIOUS_FRAME], "live", evaluation.live.previous)
        yield _baseline(PREVIOUS_FRAME, LABELS[PREVIOUS_FRAME], "settled", evaluation.live.settled_previous)
    if evaluation.second_eye is not None:
        for name, score in evaluation.second_eye.baselines.items():
            yield _baseline(name, LABELS[name], "second_eye", score)
    if evaluation.retention is not None:
        yield _baseline("last_frame", "The stream's last frame, frozen", "last", evaluation.retention.frozen)


def _baseline(name: str, label: str, frames_of: str, score: BaselineScore, age: int | None = None) -> BaselineFacts:
    return BaselineFacts.model_validate(
        {
            "name": name,
            "label": label,
            "frames_of": frames_of,
            "age_frames": age,
            "sees_future": name in SEES_THE_FUTURE,
            **asdict(score),
        }
    )


def _lines(log: Path) -> int:
    return sum(1 for _ in read_frames(log))


def _series(log: Path, per_entry: int) -> list[LogLine]:
    return list(series(read_frames(log), per_entry))
