"""From what a run has reached to its reports on disk."""

from __future__ import annotations

from pathlib import Path

import torch

from gsplat_core.training.metrics import QualityTracker
from operators.applications.result import RunOutcome
from services.reports.html import write_html
from services.reports.machine import machine_facts
from services.reports.pictures import keyframe_pictures
from services.reports.schema import (
    BaselineQuality,
    FrameCounts,
    FrameEntry,
    Latency,
    ModelFacts,
    OperatorTimes,
    Quality,
    QualityReport,
    RecordingFacts,
    RunFacts,
    RunReport,
)
from services.version import product_version


def build_report(outcome: RunOutcome) -> RunReport:
    """The outcome in the report's shape."""
    recording, model, baselines = outcome.recording, outcome.model, outcome.baselines
    return RunReport(
        recording=RecordingFacts(
            name=recording.name,
            frames=recording.frame_count,
            width_px=recording.width_px,
            height_px=recording.height_px,
            fps=recording.fps,
            digest=recording.digest,
        ),
        run=RunFacts(
            device=outcome.device,
            engine=outcome.engine,
            seed=outcome.seed,
            version=product_version(),
            threads=torch.get_num_threads(),
            wall_s=round(outcome.wall_s, 3),
            command=outcome.command,
            field=outcome.field,
            steps_per_frame=outcome.steps_per_frame,
            scale=outcome.scale,
            started_at=outcome.started_at.isoformat(timespec="seconds"),
            stop_reason=outcome.stop_reason,
            interrupted=outcome.interrupted,
            peak_memory_bytes=outcome.peak_memory_bytes,
            machine=machine_facts(),
        ),
        frames=FrameCounts(ingested=outcome.ingested, displayed=outcome.displayed, dropped=outcome.dropped),
        latency_ms={
            path: Latency(p50=_ms(t.p50_ms), p95=_ms(t.p95_ms), p99=_ms(t.p99_ms), max=_ms(t.max_ms))
            for path, t in outcome.latency.items()
        },
        operators={
            name: OperatorTimes(calls=t.count, p50_ms=_ms(t.p50_ms), p99_ms=_ms(t.p99_ms))
            for name, t in outcome.operators.items()
        },
        quality=QualityReport(
            live=_quality(outcome.live),
            heldout=_quality(outcome.held_out),
            training=_quality(outcome.training),
            baselines=BaselineQuality(
                previous_frame_db=baselines.previous_frame_db if baselines else None,
                train_mean_db=baselines.heldout_train_mean_db if baselines else None,
                heldout_previous_frame_db=baselines.heldout_previous_frame_db if baselines else None,
                heldout_neighbour_mean_db=baselines.heldout_neighbour_mean_db if baselines else None,
            ),
        ),
        model=None
        if model is None
        else ModelFacts(
            gaussians=model.gaussians.count,
            parameters=model.parameter_count,
            sha256=model.sha256(),
            version=model.version,
        ),
        frames_sha256=outcome.frames_sha256,
        notes=list(outcome.notes),
        outputs={name: path.name for name, path in outcome.outputs.items()},
        latency_quantiles_ms={path: [_ms(v) for v in curve] for path, curve in outcome.latency_quantiles_ms.items()},
        series=[FrameEntry.model_validate(entry) for entry in outcome.series],
    )


def write_reports(outcome: RunOutcome, folder: Path) -> RunReport:
    """Write `report.json` and `report.html`; each is whole or not there. Raises StorageFull."""
    report = build_report(outcome)
    report = report.model_copy(update={"outputs": {**report.outputs, "report": "report.json", "page": "report.html"}})
    report.write(folder / "report.json")
    write_html(
        report, [keyframe_pictures(frame) for frame in outcome.keyframes], folder / "report.html", outcome.worst_seq
    )
    return report


def _quality(tracker: QualityTracker | None) -> Quality | None:
    return None if tracker is None else Quality(**tracker.means(), frames=len(tracker.frames))


def _ms(value: float) -> float:
    """Milliseconds to the microsecond; the clock knows no more."""
    return round(value, 3)
