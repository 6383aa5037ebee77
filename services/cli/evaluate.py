"""Implementation of `intrasplat evaluate`."""

from __future__ import annotations

import json
import math
import tempfile
from dataclasses import asdict
from pathlib import Path

import typer

from gsplat_core.errors import InvalidSetting
from gsplat_core.evaluation.protocols import Visits
from gsplat_core.io.model_sources import is_scene_file
from gsplat_core.value_ranges import plain_float
from operators.applications.evaluate import EvaluationSettings, evaluate
from operators.applications.static_scene import EVALUATION_FILE, SceneScore, SceneSettings, evaluate_scene
from operators.output_folder import OutputFolder
from services.cli.exit_codes import INTERRUPTED, OK
from services.cli.options import EvaluateOptions, renderer_options
from services.cli.terminal import InterruptRequest, ProgressPrinter, printable
from services.reports.evaluation import EvaluationReport, build_evaluation, load_evaluated
from services.reports.evaluation_html import decibels, future, geometry_lines, measured, write_evaluation

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
        with tempfile.TemporaryDirectory(prefix="intrasplat-") as folder:
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
    typer.echo("\n".join([*table(report), *geometry_lines(report)]))
    if out is not None:
        typer.echo(str(out / "evaluation.html"))


def table(report: EvaluationReport) -> list[str]:
    """Format the scores as aligned lines: each protocol, with its baselines indented below."""
    rows = [("", "frames", "tissue dB", "frame dB", "SSIM", "worst dB")]
    found = measured(report)
    for each in found:
        score = each.score
        ssim = "–" if score.ssim is None else f"{score.ssim:.4f}"
        values = decibels(score.psnr_tissue_db), decibels(score.psnr_frame_db), ssim, decibels(score.worst_db)
        rows.append((f"{each.name}: {each.what}", str(score.frames), *values))
        rows += [_baseline(future(b), b.frames, b.psnr_tissue_db, b.psnr_frame_db) for b in each.baselines]
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
