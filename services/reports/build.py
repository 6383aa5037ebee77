"""Conversion of a run's outcome to its report files, and the error for a run without displayed frames."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.depth import DepthShare
from gsplat_core.evaluation.scores import finite
from gsplat_core.training.metrics import QualityTracker
from gsplat_core.training.offline import ChosenSteps
from operators.applications.session import RunOutcome
from operators.checks import WITHHELD as OUT_OF_BODY
from operators.checks import OutOfBodyFrames, StageCounts
from operators.display import LiveDisplayResult
from operators.errors import NothingShown
from operators.frame_log import LogLine
from operators.graph.tracking import DurationSummary
from operators.ingest import SourceResult
from operators.metrics import NextFrameResult, OnScreenResult, QualityResult
from operators.reconstruct import ModelResult, TrainedEyes
from operators.sinks.sink import KeyframesResult
from operators.sinks.video import DisplayResult
from operators.training import TrainingCounts
from operators.truth import TruthResult
from services import product_version
from services.reports.figures import hidden_pictures, keyframe_pictures
from services.reports.html import write_html
from services.reports.schema import (
    BaselineQuality,
    BetweenQuality,
    BinEntry,
    DepthErrors,
    FrameCounts,
    FrameEntry,
    Latency,
    LiveFacts,
    ModelFacts,
    NextFrameQuality,
    OperatorTimes,
    Quality,
    QualityReport,
    RecordingFacts,
    RunFacts,
    RunReport,
    TrainingSteps,
    TrialFacts,
    TruthFacts,
    machine_facts,
)


def live_facts(outcome: RunOutcome) -> LiveFacts | None:
    """Convert the results of a live run's operators to report facts; None for other runs."""
    screen, scores = outcome.find(LiveDisplayResult), outcome.find(OnScreenResult)
    training = outcome.find(TrainingCounts)
    if screen is None or scores is None or training is None:
        return None
    age = screen.age
    return LiveFacts(
        settled_psnr_tissue_db=_rounded(scores.settled_db),
        worst_psnr_tissue_db=_rounded(scores.worst_db),
        previous_frame_db=_rounded(scores.previous_frame_db),
        pictures=screen.pictures,
        age_p50_ms=round(age.p50_ms, 2),
        age_p95_ms=round(age.p95_ms, 2),
        age_p99_ms=round(age.p99_ms, 2),
        age_max_ms=round(age.max_ms, 2),
        settled_age_p99_ms=_p99(screen.settled_age),
        used_age_p99_ms=_p99(screen.used_age),
        first_picture_ms=_rounded(screen.first_picture_ms),
        states=screen.states,
        dropped=_passed_over(outcome, training),
        withheld=training.withheld,
        scenes=training.scenes,
        analysis={
            part.name: dict(part.found)
            for part in outcome.parts.values()
            if isinstance(part, StageCounts) and part.found
        },
        frames_trained=training.frames,
        steps=training.steps,
        rehearsed_steps=training.rehearsed,
        unscored=scores.unscored,
        not_on_screen=scores.not_on_screen,
    )


def _passed_over(outcome: RunOutcome, training: TrainingCounts) -> dict[str, int]:
    counts = dict(outcome.dropped_by_edge)
    if training.passed_over:
        counts["reconstruct"] = training.passed_over
    return counts


def _p99(age: DurationSummary) -> float | None:
    return round(age.p99_ms, 2) if age.count else None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def build_report(outcome: RunOutcome) -> RunReport:
    """Convert the outcome to a report.

    Raises:
        InvalidInput: if the run had no source or measured nothing.
    """
    source, quality = outcome.find(SourceResult), outcome.find(QualityResult)
    if source is None or quality is None:
        raise InvalidInput(f"a report needs a SourceResult and a QualityResult; the {outcome.command} has none")
    model, training = outcome.find(ModelResult), outcome.find(TrainingCounts)
    return RunReport(
        recording=RecordingFacts.of(source.description),
        run=_run(outcome),
        frames=FrameCounts(
            ingested=source.frames,
            displayed=displayed(outcome),
            dropped=outcome.dropped + (0 if training is None else training.passed_over),
            damaged=source.damaged,
        ),
        latency_ms={
            path: Latency(p50=_ms(t.p50_ms), p95=_ms(t.p95_ms), p99=_ms(t.p99_ms), max=_ms(t.max_ms))
            for path, t in outcome.latency.items()
        },
        operators={
            name: OperatorTimes(calls=t.count, p50_ms=_ms(t.p50_ms), p99_ms=_ms(t.p99_ms))
            for name, t in outcome.operators.items()
        },
        quality=_qualities(outcome, quality),
        model=None
        if model is None
        else ModelFacts(
            gaussians=model.model.gaussians.count,
            parameters=model.model.parameter_count,
            sha256=model.model.sha256(),
            version=model.model.version,
        ),
        live=live_facts(outcome),
        frames_sha256=quality.frames_sha256,
        notes=list(outcome.notes),
        outputs={name: path.name for name, path in outcome.outputs.items()},
        latency_quantiles_ms={path: [_ms(v) for v in curve] for path, curve in outcome.latency_quantiles_ms.items()},
        series=[_entry(entry, FrameEntry if quality.frames_per_entry == 1 else BinEntry) for entry in quality.series],
        series_frames_per_entry=quality.frames_per_entry,
    )


def displayed(outcome: RunOutcome) -> int:
    """Return the number of frames that a run displayed; of a live run, the number of new pictures; 0 without results."""
    video, screen, quality = (outcome.find(kind) for kind in (DisplayResult, LiveDisplayResult, QualityResult))
    if isinstance(screen, LiveDisplayResult):
        return screen.pictures
    if isinstance(video, DisplayResult):
        return video.frames
    return quality.frames if isinstance(quality, QualityResult) else 0


def _entry(entry: LogLine, kind: type[FrameEntry]) -> FrameEntry:
    return kind.model_validate({name: value for name, value in entry.items() if name in kind.model_fields})


def _run(outcome: RunOutcome) -> RunFacts:
    settings, eyes, steps = outcome.settings, outcome.find(TrainedEyes), outcome.find(ChosenSteps)
    return RunFacts(
        device=settings.device,
        engine=settings.engine,
        seed=settings.seed,
        version=product_version(),
        threads=torch.get_num_threads(),
        wall_s=round(outcome.wall_s, 3),
        command=outcome.command,
        field=settings.field,
        renderer=settings.renderer,
        steps_per_frame=settings.steps_per_frame,
        training_steps=None if steps is None else _training_steps(steps),
        eyes="left" if eyes is None else eyes.eyes,
        scale=settings.scale,
        started_at=outcome.started_at.isoformat(timespec="seconds"),
        stop_reason=outcome.stop_reason,
        interrupted=outcome.interrupted,
        peak_memory_bytes=outcome.peak_memory_bytes,
        machine=machine_facts(),
    )


def _training_steps(chosen: ChosenSteps) -> TrainingSteps:
    trials = [
        TrialFacts(steps=one.steps, psnr_tissue_db=finite(one.psnr_db), setup_s=one.setup_s, seconds=one.seconds)
        for one in chosen.trials
    ]
    return TrainingSteps(steps=chosen.steps, reason=chosen.reason, trials=trials)


def _qualities(outcome: RunOutcome, quality: QualityResult) -> QualityReport:
    offline = outcome.command == "reconstruct"
    between = quality.heldout_between
    return QualityReport(
        live=None if offline else _quality(quality.trained),
        next_frame=_next_frame(outcome.find(NextFrameResult)),
        truth=_truth(outcome.find(TruthResult)),
        training=_quality(quality.trained) if offline else None,
        heldout=_quality(quality.held_out) if outcome.settings.heldout else None,
        heldout_between=None
        if between is None
        else BetweenQuality(psnr_tissue_db=between.psnr_tissue_db, frames=between.frames),
        baselines=BaselineQuality(
            previous_frame_db=quality.previous_frame_db,
            heldout_previous_frame_db=quality.heldout_previous_frame_db,
            heldout_neighbour_mean_db=None if between is None else between.neighbour_mean_db,
        ),
    )


def _next_frame(result: NextFrameResult | None) -> NextFrameQuality | None:
    if result is None or not result.frames:
        return None
    return NextFrameQuality(
        psnr_tissue_db=result.psnr_tissue_db, previous_frame_db=result.previous_frame_db, frames=result.frames
    )


def _truth(result: TruthResult | None) -> TruthFacts | None:
    if result is None or (result.behind_tools is None and result.depth is None):
        return None
    behind = result.behind_tools
    return TruthFacts(
        behind_tools_psnr_db=None if behind is None else behind.psnr_db,
        last_seen_psnr_db=None if behind is None else behind.last_seen_db,
        inpainted_psnr_db=None if behind is None else behind.inpainted_db,
        frames=0 if behind is None else behind.frames,
        depth=_depth(result.depth),
        depth_behind_tools=_depth(result.depth_behind_tools),
    )


def _depth(share: DepthShare | None) -> DepthErrors | None:
    if share is None:
        return None
    return DepthErrors(
        reconstruction=share.rmse_share,
        level_plane=share.level_rmse_share,
        best_plane=share.plane_rmse_share,
        frames=share.frames,
    )


def write_reports(outcome: RunOutcome, folder: Path) -> RunReport:
    """Write `report.json` and `report.html`, each atomically.

    Raises:
        OutputError: if a file cannot be written, for example because the disk is full (StorageFull).
    """
    report = build_report(outcome)
    report = report.model_copy(update={"outputs": {**report.outputs, "report": "report.json", "page": "report.html"}})
    report.write(folder / "report.json")
    kept = outcome.find(KeyframesResult) or KeyframesResult((), None)
    pictures = [keyframe_pictures(frame) for frame in kept.keyframes]
    model = outcome.find(ModelResult)
    hidden = hidden_pictures(kept.keyframes[-1], model.model) if kept.keyframes and model is not None else None
    write_html(report, pictures, folder / "report.html", kept.worst_seq, hidden)
    return report


def _quality(tracker: QualityTracker) -> Quality:
    return Quality(**tracker.means(), frames=tracker.count)


def _ms(value: float) -> float:
    """Round a time in milliseconds to microseconds, the resolution of the clock."""
    return round(value, 3)


CHECK_PICTURE = "check what the source sends"
REMEDIES = {
    OUT_OF_BODY: "--out-of-body off lets these frames pass",
    "no tissue": "--tool-mask none takes every pixel for tissue",
    "tool mask lost": "--tool-mask none takes every pixel for tissue",
    "damaged": "check the connection, or the file",
    **dict.fromkeys(("black", "one colour", "noise", "duplicate", "frozen", "torn", "out of order"), CHECK_PICTURE),
    **dict.fromkeys(("blur", "smoke", "cut in doubt"), "a longer run shows such a stream after a second or two"),
}
"""Remedy for the user by the reason for which frames were withheld, for runs that displayed no frame."""


def require_shown(outcome: RunOutcome) -> None:
    """Check that a run displayed a frame.

    An interrupted run without withheld frames is accepted, because it may have ended before its first picture.

    Raises:
        NothingShown: if no frame was displayed. The message has the frame counts, the reasons and the remedy.
    """
    if displayed(outcome):
        return
    source = outcome.find(SourceResult)
    frames = 0 if source is None else source.frames
    live = outcome.command == "live"
    withheld = withheld_frames(outcome)
    if outcome.interrupted and not withheld:
        return
    if source is None or not frames:
        name = "the source" if source is None else source.description.name
        state = source.state_sentence if source is not None and source.state_sentence else outcome.stop_reason
        hint = "check that it is sending, or give more --seconds" if live else "check that it holds frames"
        if source is not None and source.counts.get("cut_off"):
            hint = "its data end within the first frame: check the size and format that the address states"
        raise NothingShown(f"nothing was shown: no frame came from {name} in {outcome.wall_s:.1f} s ({state}); {hint}")
    came = f"nothing was shown: {frames} {'frame' if frames == 1 else 'frames'} came"
    if not withheld:
        hint = "give more --seconds, or a smaller --scale" if live else "check the recording"
        raise NothingShown(f"{came}, and the run ended before one was on the screen ({outcome.stop_reason}); {hint}")
    counts = ", ".join(f"{_named(outcome, reason)}: {count}" for reason, count in withheld.most_common())
    # Frames of a recorded session were checked when they were recorded.
    if live or (outcome.find(OutOfBodyFrames) is not None and not source.withheld):
        remedies = "; ".join(dict.fromkeys(REMEDIES.get(reason, CHECK_PICTURE) for reason, _ in withheld.most_common()))
        where = ""
    else:
        remedies, where = "record the stream again with settings that let its frames pass", " when they were recorded"
        if set(withheld) == {"damaged"}:
            remedies, where = REMEDIES["damaged"], ""
    raise NothingShown(f"{came}, {withheld.total()} withheld{where} ({counts}); {remedies}")


def withheld_frames(outcome: RunOutcome) -> Counter[str]:
    """Count a run's withheld frames by reason, from the gates of a live run or from the recording."""
    training, source = outcome.find(TrainingCounts), outcome.find(SourceResult)
    # A session was checked when it was recorded, and its replay does not train on such frames.
    if training is not None and (source is None or not source.withheld):
        return Counter(training.withheld)
    found = Counter() if source is None else Counter(source.withheld)
    if source is not None and source.damaged:
        found["damaged"] = source.damaged
    return found


def _named(outcome: RunOutcome, reason: str) -> str:
    """Return the reason why frames were withheld. For the out-of-body gate, its most frequent evidence is appended."""
    gate = outcome.find(OutOfBodyFrames)
    if reason != OUT_OF_BODY or gate is None or not gate.withheld:
        return reason
    most = max(gate.withheld, key=lambda evidence: gate.withheld[evidence])
    return f"{reason}, mostly for {most}"
