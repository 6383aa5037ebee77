"""Implementation of `intrasplat batch`: progress, interruption, summary."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import typer

from gsplat_core.depth.maps import check_depth
from operators.settings import JobOptions
from services.cli.terminal import ASKING, BAD_INPUT, INTERRUPTED, NOTHING_SHOWN, OK, printable
from services.jobs.batch import Batch, Counts, Summary
from services.jobs.pool import PoolSettings, new_runner

SAY_S = 5.0


def batch_command(
    folder: Path, out: Path | None, workers: int | None, options: Mapping[str, Any], *, as_json: bool
) -> int:
    """Replay the recordings of a folder and print a summary.

    Returns:
        The exit code; NOTHING_SHOWN if no recording showed a frame.
    """
    out = out or folder.absolute().with_name(f"{folder.absolute().name}-replays")
    batch = Batch(folder, out, _checked(options))
    cores = os.cpu_count() or 1
    workers = workers or (1 if options["device"] == "cuda" else max(1, cores // 2))
    settings = PoolSettings(workers, threads=max(1, cores // workers))
    asked = _Asked()
    summary = batch.run(new_runner(None), settings, _Teller(as_json), asked)
    _print(summary, out, as_json)
    if asked():
        typer.echo("interrupted: the same command goes on with what is left", err=True)
        return INTERRUPTED
    if summary.is_whole:
        return OK
    left = sum(summary.counts.values()) + len(summary.unusable) - summary.counts["done"]
    typer.echo(
        f"error: {left} recordings have no result; mend what is said about each, and the same command goes on with them",
        err=True,
    )
    nothing = [str(job.reason).startswith("nothing was shown") for job in summary.failed]
    return NOTHING_SHOWN if nothing and all(nothing) and not summary.counts["done"] else BAD_INPUT


def _checked(options: Mapping[str, Any]) -> JobOptions:
    chosen = JobOptions(**options)
    check_depth(chosen.depth)  # an unusable network of onnx:FILE must fail before the first recording
    return chosen


class _Asked:
    """Stop flag that signals set and the job pool polls. Unlike `InterruptRequest` it starts no thread, because the
    pool forks.
    """

    def __init__(self) -> None:
        self._number = 0
        for number in ASKING:
            signal.signal(number, self._take)

    def __call__(self) -> bool:
        return self._number != 0

    def _take(self, number: int, frame: FrameType | None) -> None:
        self._number = number


class _Teller:
    """Progress callback that prints the job counts of a batch to standard error every few seconds."""

    def __init__(self, quiet: bool) -> None:
        self._quiet, self._said_s, self._said = quiet, 0.0, ""

    def __call__(self, counts: Counts) -> None:
        ended, every = counts["done"] + counts["failed"] + counts["cancelled"], sum(counts.values())
        said = f"{ended}/{every} recordings" + (f", {counts['failed']} failed" if counts["failed"] else "")
        if self._quiet or said == self._said or (time.monotonic() - self._said_s < SAY_S and ended < every):
            return
        self._said_s, self._said = time.monotonic(), said
        print(said, file=sys.stderr, flush=True)  # noqa: T201


def _print(summary: Summary, out: Path, as_json: bool) -> None:
    failed = [{"recording": job.recording, "reason": job.reason} for job in summary.failed]
    failed += [{"recording": name, "reason": reason} for name, reason in summary.unusable]
    if as_json:
        content = {
            **summary.counts,
            "already": summary.already,
            "seconds": round(summary.seconds, 1),
            "failures": failed,
        }
        typer.echo(json.dumps(content, indent=2))
        return
    for each in failed:
        # A reason names the operator in a second line. Other line ends come from names and stay escaped.
        reason = str(each["reason"]).replace("\n  in operator ", " In operator ")
        typer.echo(f"failed: {printable(str(each['recording']))}: {printable(reason)}", err=True)
    done, new = summary.counts["done"], summary.counts["done"] - summary.already
    typer.echo(
        f"{done} of {sum(summary.counts.values()) + len(summary.unusable)} recordings have their result, {new} of them new, in {summary.seconds:.1f} s"
    )
    typer.echo(str(out))
