"""Progress output: plain lines without a terminal, none if quiet; standard output stays empty."""

from __future__ import annotations

import io
import sys
from types import SimpleNamespace

from operators.applications.session import Progress
from services.cli.terminal import ProgressPrinter


def test_progress_lines_have_counts_rates_and_eta(capsys, monkeypatch):
    now = iter([0.0, 4.0, 5.0, 10.0, 13.0, 14.0])
    monkeypatch.setattr("services.cli.terminal.time.monotonic", lambda: next(now))
    with ProgressPrinter() as printer:
        printer(Progress("replay", 0, 10))
        printer(Progress("replay", 1, 10))
        printer(Progress("replay", 2, 10))
        printer(Progress("replay", 7, 10, psnr_tissue_db=38.126, previous_frame_db=37.3))
        printer(Progress("replay", 10, 10))
        printer(Progress("evaluate", 1, 5))
    captured = capsys.readouterr()
    assert captured.err.splitlines() == [
        "replay 0/10",
        "replay 1/10",
        "replay 7/10  1.0 frames/s  eta 3 s  38.13 dB (training error, previous frame 37.30 dB)",
        "replay 10/10  1.0 frames/s",
        "evaluate 1/5",
    ]
    assert captured.out == ""


def test_progress_printer_with_quiet_prints_nothing(capsys):
    with ProgressPrinter(quiet=True) as printer:
        printer(Progress("replay", 10, 10))
    assert capsys.readouterr() == ("", "")


def test_progress_labels_psnr_of_heldout_frame(capsys):
    with ProgressPrinter() as printer:
        printer(Progress("replay", 1, 1, psnr_tissue_db=33.0, previous_frame_db=36.0, trained=False))
        printer(Progress("evaluate", 1, 1, psnr_tissue_db=33.0))
    assert capsys.readouterr().err.splitlines() == [
        "replay 1/1  33.00 dB (held out, previous frame 36.00 dB)",
        "evaluate 1/1  33.00 dB (training error)",
    ]


def test_progress_on_terminal_has_bar_per_stage(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    now = iter([0.0, 4.0, 5.0, 10.0, 11.0])
    monkeypatch.setattr(sys, "stderr", Terminal())
    printer = ProgressPrinter()
    with printer:
        monkeypatch.setattr("services.cli.terminal.time", SimpleNamespace(monotonic=lambda: next(now)))
        assert printer._bar.live.is_started
        printer(Progress("replay", 0, 10))
        printer(Progress("replay", 1, 10))
        printer(Progress("replay", 2, 10))
        printer(Progress("replay", 7, 10, psnr_tissue_db=38.126))
        printer(Progress("evaluate", 1, 5))
        first, second = printer._bar.tasks
        assert (first.description, first.completed, first.total) == ("replay", 7, 10)
        assert first.fields == {"rate": "1.0 frames/s", "quality": "38.13 dB (training error)"}
        assert (second.description, second.completed, second.total) == ("evaluate", 1, 5)
        assert second.fields["rate"] == ""
    assert not printer._bar.live.is_started
