"""Reasons of process ends, and events of a lost or recovered source."""

from __future__ import annotations

import logging

import pytest

from services.api.app import event_receiver
from services.api.observability import StreamMeasures
from services.audit.log import SystemEvents
from services.supervisor import process as processes
from services.supervisor.launcher import Direct, last_words
from services.supervisor.process import SOURCE_GONE, ManagedProcess
from services.supervisor.worker import ProcessSpec, SourceSpec

LOGGED = "2026-11-23 19:00:00,123 {} services.supervisor.capture: {}\n"


@pytest.mark.parametrize(
    ("printed", "reason"),
    [
        (LOGGED.format("ERROR", "fps is 'nan'; give a number"), "fps is 'nan'; give a number"),
        (LOGGED.format("INFO", "x") + LOGGED.format("ERROR", "why") + LOGGED.format("INFO", "the end"), "why"),
        (LOGGED.format("ERROR", "two lines\n  of a sentence") + LOGGED.format("INFO", "x"), "two lines of a sentence"),
        (LOGGED.format("ERROR", "first") + LOGGED.format("ERROR", "second"), "second"),
        (LOGGED.format("INFO", "only this"), "only this"),
        ("Traceback\nKeyError: 'x'\n", "KeyError: 'x'"),
        (LOGGED.format("ERROR", "rtsp://me:s3cret@10.0.0.1/x is gone"), "rtsp://**********@10.0.0.1/x is gone"),
        ("\n \n", ""),
        ("", ""),
    ],
)
def test_last_words_return_last_error_of_log(tmp_path, printed, reason):
    (tmp_path / "log").write_text(printed)
    assert last_words(tmp_path / "log") == reason
    assert last_words(tmp_path / "none") == ""


@pytest.fixture
def capture(runtime, monkeypatch):
    """Return a function that feeds a heartbeat to a capture process and returns the kinds of its events."""
    events, now_s = [], [100.0]
    monkeypatch.setattr(processes.time, "monotonic", lambda: now_s[0])
    spec = ProcessSpec(stream="theatre", capture=SourceSpec(address="synthetic:"))
    managed = ManagedProcess(spec, runtime.stream("theatre"), Direct(), events.append)

    def beat(state: str, seconds: float = 0.25) -> list[str]:
        now_s[0] += seconds
        managed._take({"state": state, "reason": "cannot open rtsp://10.0.0.1/smith"})
        said = [event.kind for event in events]
        return said

    beat.events = events  # type: ignore[attr-defined]
    return beat


@pytest.mark.parametrize("gone", SOURCE_GONE)
def test_source_loss_and_recovery_are_reported_once(capture, gone, caplog):
    caplog.set_level(logging.INFO)
    assert capture("live") == []
    for _ in range(7):
        assert capture(gone) == [], "a short break"
    assert capture("live") == []
    for _ in range(40):
        said = capture(gone)
    assert said == ["lost"]
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert capture("live") == ["lost", "recovered"] == capture("live")
    for _ in range(10):
        said = capture("lost")
    assert said == ["lost", "recovered", "lost"]


def test_source_is_lost_after_long_opening_but_not_while_starting(capture):
    for _ in range(100):
        assert capture("starting") == []
    for _ in range(9):
        said = capture("opening")
    assert said == ["lost"]


def test_audit_log_records_source_loss_without_address(capture):
    for _ in range(20):
        capture("lost")
    capture("live")
    events, heard = SystemEvents(), []
    events.tell = lambda *values, **detail: heard.append((values, detail))  # type: ignore[method-assign]
    for event in capture.events:
        event_receiver(StreamMeasures(), events)(event)
    reason = {"reason": "the log has the reason"}
    assert heard == [(("source.lost", "theatre", "failed"), reason), (("source.recovered", "theatre", "done"), reason)]
