"""What `replay` and `reconstruct` have in common: progress, interruption, reports, a summary."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import typer

from operators.applications.delivery import Report
from operators.applications.progress import ProgressCallback
from operators.applications.result import RunOutcome
from services.cli.exit_codes import INTERRUPTED, OK
from services.cli.interrupt import InterruptRequest
from services.cli.progress import ProgressPrinter
from services.cli.streams import printable
from services.reports.build import write_reports
from services.reports.schema import RunReport

Run = Callable[[ProgressCallback, Callable[[], bool], Report], RunOutcome]


def report_run(run: Run, out: Path, *, as_json: bool) -> int:
    """Run, write the reports whatever the end, print the result; returns the exit code."""
    written: list[RunReport] = []

    def report(outcome: RunOutcome, folder: Path) -> None:
        written.append(write_reports(outcome, folder))

    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as progress:
        run(progress, interrupt, report)
    if not written:
        typer.echo("interrupted before there was anything to write", err=True)
        return INTERRUPTED
    print_report(written[0], out, as_json=as_json)
    return INTERRUPTED if interrupt.requested else OK


def print_report(report: RunReport, out: Path, *, as_json: bool) -> None:
    """The report as JSON, or its main figures in a few lines and where the page is."""
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
    for name, part, baseline in (
        ("live", quality.live, quality.baselines.previous_frame_db),
        ("held-out", quality.heldout, quality.baselines.heldout_previous_frame_db),
        ("training", quality.training, None),
    ):
        if part is not None and part.psnr_tissue_db is not None:
            beside = "" if baseline is None else f" (previous frame shown instead: {baseline:.2f} dB)"
            lines.append(f"{name} tissue PSNR {part.psnr_tissue_db:.2f} dB{beside}")
    typer.echo("\n".join(lines))
    typer.echo(str(out / "report.html"))
