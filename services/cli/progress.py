"""Progress output on stderr, so stdout holds only the result: a live bar on a terminal, plain lines otherwise."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.progress import TaskID

    from operators.applications.progress import Progress

PLAIN_PERIOD_S = 5.0


class ProgressPrinter:
    """Context manager that prints `Progress` events."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._terminal = not quiet and sys.stderr.isatty()
        self._stage = ""
        self._printed_s = 0.0
        self._measured_from: tuple[float, int] | None = None
        self._bar: Bar | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> ProgressPrinter:
        if self._terminal:
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                TextColumn,
                TimeElapsedColumn,
                TimeRemainingColumn,
            )

            self._bar = Progress(
                TextColumn("[bold]{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TextColumn("[cyan]{task.fields[quality]}"),
                TimeElapsedColumn(),
                TextColumn("eta"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, progress: Progress) -> None:
        """Update the bar on a terminal. Otherwise print a line at the start, after the first frame and at the end of a
        stage, and every `PLAIN_PERIOD_S` in between."""
        if self._quiet:
            return
        now_s = time.monotonic()
        first = progress.stage != self._stage
        if first:
            self._stage, self._printed_s, self._measured_from = progress.stage, now_s, None
        begun = self._measured_from is None and progress.done > 0
        if begun:
            # The first frame initialises the model and is far slower, so the rate excludes it.
            self._measured_from = now_s, progress.done
        rate = 0.0
        if self._measured_from and now_s > self._measured_from[0]:
            rate = (progress.done - self._measured_from[1]) / (now_s - self._measured_from[0])
        quality = _quality(progress)
        rate_text = f"{rate:.1f} {progress.unit}/s" if rate else ""
        if self._bar is not None:
            if first:
                self._task = self._bar.add_task(progress.stage, total=progress.total, rate="", quality="")
            assert self._task is not None
            self._bar.update(self._task, completed=progress.done, rate=rate_text, quality=quality)
            return
        finished = progress.done == progress.total
        if not (first or begun or finished or now_s - self._printed_s >= PLAIN_PERIOD_S):
            return
        self._printed_s = now_s
        parts = [f"{progress.stage} {progress.done}/{progress.total}"]
        if rate:
            parts.append(rate_text)
            if not finished:
                parts.append(f"eta {(progress.total - progress.done) / rate:.0f} s")
        if quality:
            parts.append(quality)
        print("  ".join(parts), file=sys.stderr, flush=True)  # noqa: T201


def _quality(progress: Progress) -> str:
    """Return the PSNR of the newest frame with its kind of error and the trivial baseline."""
    if progress.psnr_tissue_db is None:
        return ""
    kind = "training error" if progress.trained else "held out"
    beside = "" if progress.previous_frame_db is None else f", previous frame {progress.previous_frame_db:.2f} dB"
    return f"{progress.psnr_tissue_db:.2f} dB ({kind}{beside})"
