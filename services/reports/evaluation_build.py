"""Conversion of an evaluation's measurements to its report files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from gsplat_core.evaluation.baselines import (
    HALF_VELOCITY,
    HALF_WAY,
    NEIGHBOUR_MEAN,
    PREVIOUS_FRAME,
    SEES_THE_FUTURE,
    TRAIN_MEAN,
    BaselineScore,
)
from gsplat_core.evaluation.live import Live
from gsplat_core.evaluation.protocols import PlaceScore
from gsplat_core.evaluation.views import MATCHED, RIGHT_BEFORE, SHIFTED, SecondEye
from gsplat_core.models import Model
from operators.applications.evaluate import Evaluation, EvaluationSettings
from operators.applications.evaluated import EvaluatedRun
from operators.frame_log import MAX_SERIES, LogLine, frames_per_entry, read_frames, series
from services import product_version
from services.reports.evaluation_html import write_evaluation_html
from services.reports.evaluation_schema import (
    BaselineFacts,
    CausalFacts,
    EvaluatedFacts,
    EvaluationReport,
    GeometryFacts,
    HeldOutFacts,
    OnScreenFacts,
    PlaceFacts,
    RetentionFacts,
    ReturnFacts,
    ScoreFacts,
    SecondEyeFacts,
)
from services.reports.schema import ModelFacts, RecordingFacts, machine_facts

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


def write_evaluation(report: EvaluationReport, folder: Path) -> EvaluationReport:
    """Write `evaluation.json` and `evaluation.html`, each atomically.

    Raises:
        OutputError: if a file cannot be written, for example because the disk is full (StorageFull).
    """
    outputs = {**report.outputs, "report": "evaluation.json", "page": "evaluation.html"}
    report = report.model_copy(update={"outputs": outputs})
    report.write(folder / "evaluation.json")
    write_evaluation_html(report, folder / "evaluation.html")
    return report


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
