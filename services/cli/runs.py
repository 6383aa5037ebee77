"""Implementation of `intrasplat replay`, `reconstruct`, `live`, `train` and `evaluate`: progress, interruption, reports, summary."""

from __future__ import annotations

import json
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import typer

from gsplat_core.errors import InvalidSetting
from gsplat_core.evaluation.protocols import Visits
from gsplat_core.io.model_sources import is_scene_file
from gsplat_core.io.sessions import WriterOptions
from gsplat_core.value_ranges import plain_float
from operators.applications.evaluate import EvaluationSettings, evaluate
from operators.applications.live import live, new_recording_folder
from operators.applications.live_settings import LiveSettings
from operators.applications.reconstruct import ReconstructSettings, reconstruct
from operators.applications.replay import ReplaySettings, replay
from operators.applications.session import ProgressCallback, Report, RunOutcome
from operators.applications.static_scene import (
    EVALUATION_FILE,
    MODEL_FOLDER,
    SceneScore,
    SceneSettings,
    SceneTraining,
    evaluate_scene,
    train_scene,
)
from operators.metrics import ScoredFrame
from operators.output_folder import OutputFolder
from operators.pipeline import Pipeline
from operators.settings import TrainOptions
from operators.storage import mebibytes
from services.cli.options import EvaluateOptions, renderer_options
from services.cli.terminal import (
    INTERRUPTED,
    OK,
    InterruptRequest,
    ProgressPrinter,
    printable,
)
from services.reports.build import require_shown, write_reports
from services.reports.evaluation import EvaluationReport, build_evaluation, load_evaluated
from services.reports.evaluation_html import decibels, future, geometry_lines, measured, write_evaluation
from services.reports.schema import LiveFacts, RunReport

Run = Callable[[ProgressCallback, Callable[[], bool], Report], RunOutcome]


def report_run(run: Run, out: Path, *, as_json: bool) -> int:
    """Run, write the reports even after an error, and print the result.

    Returns:
        The exit code.

    Raises:
        NothingShown: if the run showed no frame.
    """
    written: list[RunReport] = []

    def report(outcome: RunOutcome, folder: Path) -> None:
        written.append(write_reports(outcome, folder))

    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as progress:
        outcome = run(progress, interrupt, report)
    if written:
        print_report(written[0], out, as_json=as_json)
    if not interrupt.requested or not written:
        require_shown(outcome)
    if not written:
        typer.echo("interrupted before there was anything to write", err=True)
    return INTERRUPTED if interrupt.requested else OK


def print_report(report: RunReport, out: Path, *, as_json: bool) -> None:
    """Print the report as JSON, or its main figures and the path of the page."""
    if as_json:
        typer.echo(report.model_dump_json(indent=2))
        return
    if report.run.interrupted:
        typer.echo("interrupted: the figures cover the frames that were displayed", err=True)
    for note in report.notes:
        typer.echo(f"note: {printable(note)}", err=True)
    frames, run, quality = report.frames, report.run, report.quality
    lines = [
        f"{frames.displayed} of {frames.ingested} frames displayed, {frames.dropped} dropped, in {run.wall_s:.1f} s"
    ]
    baselines = quality.baselines
    held_out, between, mean_db = quality.heldout, quality.heldout_between, baselines.heldout_neighbour_mean_db
    # The first or the last frame of a recording can be held out, and has one neighbour.
    apart = None
    if held_out is not None and between is not None and between.frames < held_out.frames:
        apart, mean_db = mean_db, None
    for name, part, previous_db, next_db in (
        ("displayed frame (training error)", quality.live, baselines.previous_frame_db, None),
        ("held-out frames", held_out, baselines.heldout_previous_frame_db, mean_db),
        ("held-out frames with both neighbours", between if apart is not None else None, None, apart),
        ("training frames (training error)", quality.training, baselines.previous_frame_db, None),
    ):
        if part is not None:
            lines += quality_line(name, part.psnr_tissue_db, previous_db, next_db)
    lines += next_frame_line(report)
    typer.echo("\n".join(lines))
    typer.echo(str(out / "report.html"))


def quality_line(
    name: str, psnr_db: float | None, previous_db: float | None, mean_db: float | None = None
) -> list[str]:
    """Return a line with a mean tissue PSNR and trivial baselines on the same frames; empty without the PSNR.

    `mean_db` is the PSNR of the mean of the two neighbouring frames.
    """
    if psnr_db is None:
        return []
    baselines = {"previous frame shown instead": previous_db, "mean of both neighbours": mean_db}
    beside = "; ".join(f"{what}: {value:.2f} dB" for what, value in baselines.items() if value is not None)
    return [f"tissue PSNR, {name}: {psnr_db:.2f} dB{f' ({beside})' if beside else ''}"]


def next_frame_line(report: RunReport) -> list[str]:
    """Return the line of the next-frame prediction score, which is no training error; empty if it was not measured."""
    measured = report.quality.next_frame
    if measured is None:
        return []
    name = "next frame, predicted before training on it"
    return quality_line(name, measured.psnr_tissue_db, measured.previous_frame_db)


def replay_command(settings: ReplaySettings, *, as_json: bool) -> int:
    """Replay and write the reports. Print the main figures and the path of the page, or the report as JSON.

    Return the exit code: OK or INTERRUPTED.
    """
    return report_run(lambda *callbacks: replay(settings, *callbacks), settings.out, as_json=as_json)


def reconstruct_command(settings: ReconstructSettings, *, as_json: bool) -> int:
    """Reconstruct offline and write the reports. Print the main figures and the path of the page, or the report as JSON.

    Return the exit code: OK or INTERRUPTED.
    """
    return report_run(
        lambda *callbacks: reconstruct(settings, settings.steps, *callbacks), settings.out, as_json=as_json
    )


_KEPT = re.compile(r"(\d+(?:\.\d+)?) *([A-Za-z]+)", re.ASCII)
_UNITS = {
    "mib": ("bytes", 2.0**20), "gib": ("bytes", 2.0**30), "tib": ("bytes", 2.0**40),
    "min": ("seconds", 60.0), "h": ("seconds", 3600.0), "d": ("seconds", 86400.0),
}  # fmt: skip
_LEAST = {"bytes": 64.0 * 2**20, "seconds": 60.0}
STATUS_PERIOD_S = 1.0
PLAIN_PERIOD_S = 5.0


class LiveStatus:
    """Status line of the display on stderr: refreshed on a terminal, printed periodically otherwise."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._terminal = not quiet and sys.stderr.isatty()
        self._period_s = STATUS_PERIOD_S if self._terminal else PLAIN_PERIOD_S
        self._printed_s = 0.0
        self._frames = 0
        self._written = False

    def __enter__(self) -> LiveStatus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._terminal and self._written:
            print(file=sys.stderr)  # noqa: T201 - ends the refreshed line

    def __call__(self, graph: Pipeline, scored: ScoredFrame) -> None:
        """Update the status line after a scored frame, at most once per period, unless quiet."""
        now_s = time.monotonic()
        if self._quiet or now_s - self._printed_s < self._period_s:
            return
        frames, since_s = graph.display.pictures, now_s - self._printed_s
        rate = (frames - self._frames) / since_s if self._written else 0.0
        self._printed_s, self._frames = now_s, frames
        state = "" if graph.display.state is None else graph.display.state.value
        line = (
            f"{state:<11} {rate:5.1f} pictures/s  age {graph.display.age_p50_ms:5.1f} ms"
            f"  training error {_decibels(scored.quality.psnr_tissue_db)} (previous frame {_decibels(scored.previous_frame_db)})"
            f"  {graph.reconstruct.newest_gaussians} Gaussians"
        )
        print(f"\r{line}" if self._terminal else line, end="" if self._terminal else "\n", file=sys.stderr, flush=True)  # noqa: T201
        self._written = True


def _decibels(psnr_db: float) -> str:
    """Return a PSNR as text of constant width for the status line; a dash without one."""
    return f"{psnr_db:5.2f} dB" if math.isfinite(psnr_db) else "    - dB"


@contextmanager
def live_settings(
    source: str,
    out: Path | None,
    record: bool = False,
    record_keep: Sequence[str] = (),
    **settings: Any,
) -> Iterator[LiveSettings]:
    """Provide the settings of a run. Without `out`, results go to a temporary folder and recording is not possible.

    Raises:
        InvalidSetting: if a setting is not valid.
    """
    if record and out is None:
        raise InvalidSetting("--record needs a folder that stays; give --out, in which recordings/ is made")
    if record_keep and not record:
        raise InvalidSetting(f"--record-keep {record_keep[0]} bounds what --record writes; give --record, too")
    kept = recording_kept(record_keep)
    if out is not None:
        recording = new_recording_folder(out) if record else None
        yield LiveSettings(source=source, out=out, record=recording, recording=kept, **settings)
        return
    with TemporaryDirectory(prefix="intrasplat-live-") as folder:
        yield LiveSettings(source=source, out=Path(folder) / "out", **settings)


def recording_kept(texts: Sequence[str]) -> WriterOptions:
    """Parse retention limits of session recordings: a size such as `20GiB`, an age such as `90min`, or both.

    Raises:
        InvalidSetting: if a text is malformed.
    """
    bounds: dict[str, float] = {}
    for text in texts:
        match = _KEPT.fullmatch(text.strip())
        kind, factor = _UNITS.get(match[2].lower() if match else "", ("", 0.0))
        if match is None or not kind or kind in bounds:
            raise InvalidSetting(
                f"record-keep is {text!r}; give a size in MiB, GiB or TiB, or a time in min, h or d, each once, such as 20GiB or 48h"
            )
        bounds[kind] = float(match[1]) * factor
        if not _LEAST[kind] <= bounds[kind] < 1e15:
            raise InvalidSetting(f"record-keep is {text!r}; it must be at least 64MiB, or 1min")
    options, size, age_s = WriterOptions(), bounds.get("bytes"), bounds.get("seconds")
    return replace(
        options,
        keep_bytes=None if size is None else int(size),
        keep_s=age_s,
        # Recordings are deleted by whole segments.
        segment_bytes=options.segment_bytes if size is None else min(options.segment_bytes, int(size / 8)),
        segment_s=options.segment_s if age_s is None else min(options.segment_s, age_s / 8),
        with_earlier=bool(bounds),
    )


def live_command(settings: LiveSettings, *, keep: bool, as_json: bool) -> int:
    """Run live, write the reports and print the result. Without `keep` the results are deleted.

    Returns:
        The exit code.

    Raises:
        NothingShown: if the run showed no frame.
    """
    written: list[RunReport] = []

    def report(outcome: RunOutcome, folder: Path) -> None:
        written.append(write_reports(outcome, folder))

    with InterruptRequest() as interrupt, LiveStatus(quiet=as_json) as status:
        outcome = live(settings, stop_requested=interrupt, on_scored=status, report=report)
    if written:
        print_live(written[0], settings.out if keep else None, as_json=as_json)
    require_shown(outcome)
    if not written:
        typer.echo("ended before there was anything to show", err=True)
        return INTERRUPTED if interrupt.requested else OK
    # A stream has no end, so an interrupt is its regular end.
    return OK


def print_live(report: RunReport, out: Path | None, *, as_json: bool) -> None:
    """Print the report as JSON, or its main figures and the path of the page."""
    if as_json:
        typer.echo(report.model_dump_json(indent=2))
        return
    for note in report.notes:
        typer.echo(f"note: {printable(note)}", err=True)
    if report.live is not None:
        typer.echo(_summary(report, report.live))
    if out is not None:
        typer.echo(str(out / "report.html"))


def _summary(report: RunReport, facts: LiveFacts) -> str:
    lines = [
        f"{report.frames.ingested} frames in {report.run.wall_s:.1f} s, {facts.pictures} pictures shown,"
        f" {sum(facts.dropped.values())} passed over; ended: {printable(report.run.stop_reason)}",
        f"age of what was shown: p50 {facts.age_p50_ms:.1f} ms, p99 {facts.age_p99_ms:.1f} ms, most {facts.age_max_ms:.1f} ms",
    ]
    # The first second, in which the model is initialised, is excluded from these figures.
    if facts.settled_age_p99_ms is not None:
        lines.append(f"age after the first second: p99 {facts.settled_age_p99_ms:.1f} ms")
    if facts.used_age_p99_ms is not None and facts.withheld:
        lines.append(f"of used frames, not withheld or damaged: p99 {facts.used_age_p99_ms:.1f} ms")
    name = "displayed frame (training error)"
    lines += quality_line(name, facts.settled_psnr_tissue_db, facts.previous_frame_db)
    lines += quality_line(f"worst {name}", facts.worst_psnr_tissue_db, None)
    lines += next_frame_line(report)
    for name, counts in (
        ("withheld", facts.withheld),
        ("new scenes", facts.scenes),
        ("changes of state", facts.states),
    ):
        if counts:
            lines.append(f"{name}: " + ", ".join(f"{count} x {reason}" for reason, count in counts.items()))
    return "\n".join(lines)


def train_command(scene: Path, out: Path, options: TrainOptions, *, as_json: bool) -> int:
    """Train a scene, publish the results in `out` and print the scores. Return the exit code: OK or INTERRUPTED."""
    with InterruptRequest() as interrupt, OutputFolder(out, "train", [scene]) as output:
        try:
            with ProgressPrinter(quiet=as_json) as progress:
                result = train_scene(scene, options, output.path, progress=progress, stop_requested=interrupt)
        except KeyboardInterrupt:
            output.publish()
            raise
        output.publish()
    if as_json:
        typer.echo(json.dumps(asdict(result), indent=2))
    else:
        typer.echo("\n".join([*_lines(result), str(out / MODEL_FOLDER)]))
    return INTERRUPTED if interrupt.requested else OK


def _lines(result: SceneTraining) -> list[str]:
    rate = result.steps / result.training_s if result.training_s else 0.0
    lines = [
        f"{result.steps} steps on {result.training_images} images in {result.training_s:.1f} s ({rate:.1f} steps/s):"
        f" {result.gaussians} Gaussians, peak memory {mebibytes(result.device_peak_bytes or result.peak_memory_bytes)}"
    ]
    score = result.heldout
    if score is not None:
        lines.append(
            f"{len(score.images)} held-out images: PSNR {score.psnr_db:.2f} dB, SSIM {score.ssim:.4f}, worst {score.worst_db:.2f} dB"
            f" ({printable(score.worst)})"
        )
    return lines


ONLY_WITH_SCENE = ("scene", "images", "every", "samples", "supersampling", "order")
ONLY_WITH_RECORDING = ("protocol", "max_frames", "steps_per_frame", "motion_prior", "place", "poses")


def scene_settings(options: EvaluateOptions) -> SceneSettings:
    """Convert the options of an evaluation without a recording.

    Raises:
        InvalidSetting: if there is no scene, or an option is not valid.
    """
    if options.scene is None:
        raise InvalidSetting("there is nothing to evaluate on; give a RECORDING, or --scene with a folder of COLMAP")
    _refuse(options, ONLY_WITH_RECORDING, "is for recordings; leave it out with --scene")
    given = {"images": options.images, "every": options.every, "scale": options.scale}
    return SceneSettings(
        options.scene,
        device=options.device,
        renderer=options.renderer,
        options=renderer_options(options.renderer, options.samples, options.supersampling, options.order),
        **{name: value for name, value in given.items() if value is not None},  # type: ignore[arg-type]
    )


def _refuse(options: EvaluateOptions, names: tuple[str, ...], why: str) -> None:
    for name in names:
        if getattr(options, name) is not None:
            raise InvalidSetting(f"--{name.replace('_', '-')} {why}")


def evaluate_scene_command(model: Path, settings: SceneSettings, out: Path | None, *, as_json: bool) -> int:
    """Evaluate a model on a scene, write the requested files, print the scores. Return the exit code: OK or INTERRUPTED."""

    def measure(folder: Path | None) -> SceneScore:
        with ProgressPrinter(quiet=as_json) as progress:
            return evaluate_scene(model, settings, folder, progress=progress, stop_requested=interrupt)

    with InterruptRequest() as interrupt:
        if out is None:
            score = measure(None)
        else:
            with OutputFolder(out, "evaluate", [model, settings.scene]) as output:
                score = measure(output.path)
                output.publish()
    if as_json:
        typer.echo(json.dumps({**asdict(score), "interrupted": interrupt.requested}, indent=2))
    else:
        typer.echo(
            f"{len(score.images)} held-out images: PSNR {score.psnr_db:.2f} dB, SSIM {score.ssim:.4f}, worst {score.worst_db:.2f} dB"
            f" ({printable(score.worst)})"
        )
        if out is not None:
            typer.echo(str(out / EVALUATION_FILE))
    return INTERRUPTED if interrupt.requested else OK


def evaluation_settings(recording: Path, options: EvaluateOptions) -> EvaluationSettings:
    """Convert command line options to settings.

    Raises:
        InvalidSetting: if an option is not valid.
    """
    _refuse(options, ONLY_WITH_SCENE, "is for scenes of COLMAP; leave it out, or leave the recording out")
    return EvaluationSettings(
        recording,
        tuple(options.protocol or ()),
        device=options.device,  # type: ignore[arg-type]  # checked by check_device
        renderer=options.renderer,
        scale=options.scale,
        max_frames=options.max_frames,
        steps_per_frame=options.steps_per_frame,
        motion_prior=options.motion_prior,
        poses=options.poses,
        places=None if options.place is None else tuple(_place(text) for text in options.place),
    )


def _place(text: str) -> Visits:
    """Parse the start and end times, in seconds, of two visits to a place, such as `0:2,60:62`.

    Raises:
        InvalidSetting: if the text is malformed.
    """
    try:
        first, again = ([plain_float(end) for end in stay.split(":")] for stay in text.split(","))
        if len(first) != 2 or len(again) != 2 or not all(math.isfinite(end) for end in (*first, *again)):
            raise ValueError
        return Visits((first[0], first[1]), (again[0], again[1]))
    except ValueError as error:
        raise InvalidSetting(
            f"place is {text!r}; give two stays in seconds, the earlier one first and apart from the other, such as 0:2,60:62"
        ) from error


def evaluate_command(path: Path, settings: EvaluationSettings, out: Path | None, *, as_json: bool) -> int:
    """Evaluate, write the requested reports and print the result. Return the exit code: OK or INTERRUPTED."""
    if is_scene_file(path):
        raise InvalidSetting(f"{path} comes from no recording; give a scene of COLMAP with --scene, or a model folder")
    model, run = load_evaluated(path)

    def measure(folder: Path) -> EvaluationReport:
        with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as progress:
            evaluation = evaluate(model, run, settings, folder, progress, interrupt)
        return build_evaluation(path, model, run, settings, evaluation)

    if out is None:
        with TemporaryDirectory(prefix="intrasplat-") as folder:
            report = measure(Path(folder)).model_copy(update={"outputs": {}})
    else:
        inputs = [path if run is None else run.folder, Path(settings.recording)]
        inputs += [] if settings.poses is None else [Path(settings.poses)]
        with OutputFolder(out, "evaluate", inputs) as output:
            report = write_evaluation(measure(output.path), output.path)
            output.publish()
    print_evaluation(report, out, as_json=as_json)
    return INTERRUPTED if report.evaluated.interrupted else OK


def print_evaluation(report: EvaluationReport, out: Path | None, *, as_json: bool) -> None:
    """Print the report as JSON, or its table and the path of the page."""
    if as_json:
        typer.echo(report.model_dump_json(indent=2))
        return
    for note in report.notes:
        typer.echo(f"note: {printable(note)}", err=True)
    typer.echo("\n".join([*evaluation_table(report), *geometry_lines(report)]))
    if out is not None:
        typer.echo(str(out / "evaluation.html"))


def evaluation_table(report: EvaluationReport) -> list[str]:
    """Format the scores as aligned lines: each protocol, with its baselines indented below."""
    rows = [("", "frames", "tissue dB", "frame dB", "SSIM", "worst dB")]
    found = measured(report)
    for each in found:
        score = each.score
        ssim = "–" if score.ssim is None else f"{score.ssim:.4f}"
        values = decibels(score.psnr_tissue_db), decibels(score.psnr_frame_db), ssim, decibels(score.worst_db)
        rows.append((f"{each.name}: {each.what}", str(score.frames), *values))
        rows += [_baseline(future(b), b.frames, b.psnr_tissue_db, b.psnr_frame_db) for b in each.baselines]
    for place in [] if report.retention is None else report.retention.places:
        for visit, stay, kept in (("first", place.first_s, place.first), ("again", place.again_s, place.again)):
            what = f"place, {visit}: {stay[0]:.2f} to {stay[1]:.2f} s"
            rows.append(_baseline(what, kept.frames, kept.psnr_tissue_db, kept.psnr_frame_db))
    if not found:
        rows += [_baseline(future(b), b.frames, b.psnr_tissue_db, b.psnr_frame_db) for b in report.baselines]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        ).rstrip()
        for row in rows
    ]
    copies = [each for each in report.baselines if each.age_frames is not None]
    if copies:
        curve = ", ".join(f"{each.age_frames}: {decibels(each.psnr_tissue_db)}" for each in copies)
        lines.append(f"a raw frame shown k frames late scores, in tissue dB: {curve}")
    if report.live is not None and report.live.age_when_shown is not None:
        ages = report.live.age_when_shown
        lines.append(
            f"age when shown: p50 {ages.p50_ms:.1f}, p95 {ages.p95_ms:.1f}, p99 {ages.p99_ms:.1f}, max {ages.max_ms:.1f} ms"
        )
    return lines


def _baseline(
    label: str, frames: int, tissue_db: float | None, frame_db: float | None
) -> tuple[str, str, str, str, str, str]:
    return f"  {label}", str(frames), decibels(tissue_db), decibels(frame_db), "", ""
