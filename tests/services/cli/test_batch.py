"""Exit codes, progress and summary of `intrasplat batch`, without a run."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsplat_core.errors import InvalidSetting
from services.cli import batch
from services.cli.terminal import BAD_INPUT, INTERRUPTED, NOTHING_SHOWN, OK
from services.jobs.batch import Summary

STATES = ("queued", "running", "done", "failed", "cancelled")


def counts(**given: int) -> dict[str, int]:
    return dict.fromkeys(STATES, 0) | given


def failed(*reasons: str) -> list[Any]:
    return [SimpleNamespace(recording=f"r{number}", reason=reason) for number, reason in enumerate(reasons)]


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Return a function that runs the command with a given summary and keeps its settings in `run.seen`."""
    seen: dict[str, Any] = {}

    def start(
        summary: Summary, *, asked: bool = False, cores: int = 8, workers: int | None = None, device="cpu"
    ) -> int:
        class Batch:
            def __init__(self, folder: Path, out: Path, options: Any) -> None:
                seen.update(folder=folder, out=out)

            def run(self, runner: Any, settings: Any, say: Any, stop: Any) -> Summary:
                seen.update(settings=settings)
                return summary

        monkeypatch.setattr(batch, "Batch", Batch)
        monkeypatch.setattr(batch, "new_runner", lambda _: None)
        monkeypatch.setattr(batch, "_Asked", lambda: lambda: asked)
        monkeypatch.setattr(batch, "_checked", lambda options: options)
        monkeypatch.setattr(batch.os, "cpu_count", lambda: cores)
        return batch.batch_command(tmp_path / "recs", None, workers, {"device": device}, as_json=False)

    start.seen = seen  # type: ignore[attr-defined]
    return start


NOTHING = "nothing was shown: all frames were withheld"


@pytest.mark.parametrize(
    ("summary", "asked", "code"),
    [
        (Summary(counts(done=2), 0, [], 1.0), False, OK),
        (Summary(counts(done=2), 0, [], 1.0), True, INTERRUPTED),
        (Summary(counts(done=1, failed=1), 0, failed("broken"), 1.0), False, BAD_INPUT),
        (Summary(counts(failed=2), 0, failed(NOTHING, NOTHING), 1.0), False, NOTHING_SHOWN),
        (Summary(counts(failed=2), 0, failed(NOTHING, "broken"), 1.0), False, BAD_INPUT),
        (Summary(counts(done=1, failed=1), 0, failed(NOTHING), 1.0), False, BAD_INPUT),
        (Summary(counts(), 0, [], 1.0, [("x", "is no recording")]), False, BAD_INPUT),
    ],
)
def test_batch_exit_code_follows_summary(run, summary, asked, code):
    assert run(summary, asked=asked) == code
    assert run.seen["out"].name == "recs-replays" and run.seen["out"].parent == run.seen["folder"].parent


@pytest.mark.parametrize(
    ("cores", "workers", "device", "expected"),
    [(8, None, "cpu", (4, 2)), (1, None, "cpu", (1, 1)), (3, None, "cpu", (1, 3)), (8, None, "cuda", (1, 8)),
     (8, 3, "cpu", (3, 2)), (2, 5, "cpu", (5, 1)), (8, 2, "cuda", (2, 4))],
)  # fmt: skip
def test_batch_divides_cores_between_workers(run, cores, workers, device, expected):
    run(Summary(counts(done=1), 0, [], 1.0), cores=cores, workers=workers, device=device)
    settings = run.seen["settings"]
    assert (settings.workers, settings.threads) == expected


def test_batch_prints_multiline_reason_as_one_line(capsys):
    summary = Summary(counts(failed=1), 0, failed("d.npy: 1 pixels are NaN.\n  in operator source"), 1.0)
    batch._print(summary, Path("out"), as_json=False)
    assert capsys.readouterr().err == "failed: r0: d.npy: 1 pixels are NaN. In operator source\n"


def test_batch_prints_summary_as_text_and_json(capsys):
    summary = Summary(counts(done=3, failed=1), 1, failed("bad\nname"), 2.04, [("y\x1b", "is no recording")])
    batch._print(summary, Path("out"), as_json=False)
    said = capsys.readouterr()
    assert said.out == "3 of 5 recordings have their result, 2 of them new, in 2.0 s\nout\n"
    assert said.err == "failed: r0: bad\\nname\nfailed: y\\x1b: is no recording\n"
    batch._print(summary, Path("out"), as_json=True)
    summary = json.loads(capsys.readouterr().out)
    assert summary == {
        **counts(done=3, failed=1), "already": 1, "seconds": 2.0,
        "failures": [{"recording": "r0", "reason": "bad\nname"}, {"recording": "y\x1b", "reason": "is no recording"}],
    }  # fmt: skip


def test_batch_progress_is_printed_every_5_s_and_at_end(capsys, monkeypatch):
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(batch, "time", SimpleNamespace(monotonic=lambda: now.s))
    tell, quiet = batch._Teller(False), batch._Teller(True)

    def said(after_s: float, **given: int) -> str:
        now.s += after_s
        quiet(counts(**given))
        tell(counts(**given))
        return capsys.readouterr().err

    assert said(0, queued=4) == "0/4 recordings\n"
    assert said(9, queued=4) == "", "nothing new"
    assert said(0, queued=3, done=1) == "1/4 recordings\n"
    assert said(4.9, queued=2, done=1, failed=1) == "", "too soon"
    assert said(0.1, queued=2, done=1, failed=1) == "2/4 recordings, 1 failed\n"
    assert said(0.1, done=2, failed=1, cancelled=1) == "4/4 recordings, 1 failed\n", "the end is said at once"


def test_batch_error_names_invalid_option():
    with pytest.raises(InvalidSetting, match="steps_per_frame is -1; it must be from 1 to"):
        batch._checked({"steps_per_frame": -1})
