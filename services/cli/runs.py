"""Common parts of `replay` and `reconstruct`: progress, interruption, reports, summary."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import typer

from operators.applications.progress import ProgressCallback
from operators.applications.session import Report, RunOutcome
from services.cli.exit_codes import INTERRUPTED, OK
from services.cli.interrupt import InterruptRequest
from services.cli.progress import ProgressPrinter
from services.cli.streams import printable
from services.reports.build import write_reports
from services.reports.nothing_shown import require_shown
from services.reports.schema import RunReport

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
    for name, part, baseline in (
        ("displayed frame (training error)", quality.live, quality.baselines.previous_frame_db),
        ("held-out frames", quality.heldout, quality.baselines.heldout_previous_frame_db),
        ("training frames (training error)", quality.training, quality.baselines.previous_frame_db),
    ):
        if part is not None:
            lines += quality_line(name, part.psnr_tissue_db, baseline)
    lines += next_frame_line(report)
    typer.echo("\n".join(lines))
    typer.echo(str(out / "report.html"))


def quality_line(name: str, psnr_db: float | None, previous_db: float | None) -> list[str]:
    """Return a line with a mean tissue PSNR and the trivial baseline on the same frames; empty
    without the PSNR."""
    if psnr_db is None:
        return []
    beside = "" if previous_db is None else f" (previous frame shown instead: {previous_db:.2f} dB)"
    return [f"tissue PSNR, {name}: {psnr_db:.2f} dB{beside}"]


def next_frame_line(report: RunReport) -> list[str]:
    """Return the line of the next-frame prediction score, which is no training error; empty if it
    was not measured."""
    measured = report.quality.next_frame
    if measured is None:
        return []
    name = "next frame, predicted before training on it"
    return quality_line(name, measured.psnr_tissue_db, measured.previous_frame_db)
