"""Notifications between the parts of a server."""

from __future__ import annotations

import asyncio
import tempfile

import pytest

from services.api.app import assembled, event_receiver
from services.api.observability import StreamMeasures
from services.audit.log import SystemEvents
from services.schemas import StreamView
from services.settings import ServiceSettings
from services.supervisor.process import StreamEvent
from services.supervisor.stream import SupervisedStreams


@pytest.mark.parametrize(
    ("reason", "kept"),
    [
        ("killed by SIGKILL", True), ("exit code 3", True), ("it has said nothing for 3.1 s; it was killed", True),
        ("for the first time", True), ("it was requested", True), ("the server ends", True),
        ("cannot open /recordings/Smith_Jane.mp4", False), ("smith", False), ("it cannot be started: /x", False),
        ("rtsp://user:pass@10.0.0.5/x does not answer", False),
    ],
)  # fmt: skip
def test_audit_log_omits_stream_end_reasons_that_may_name_files(reason, kept):
    events, heard = SystemEvents(), []
    events.tell = lambda *values, **detail: heard.append((values, detail))  # type: ignore[method-assign]
    event_receiver(StreamMeasures(), events)(StreamEvent("theatre", "engine", "ended", reason, 7))
    expected = {"pid": 7, "reason": reason if kept else "the log has the reason"}
    assert heard == [(("process.ended", "theatre/engine", "failed"), expected)]


@pytest.mark.parametrize(
    ("state", "ready"), [("live", "ready"), ("stopped", "ready"), ("source lost", "degraded"), ("failed", "degraded")]
)
def test_streams_check_is_degraded_when_stream_lost_source_or_failed(tmp_path, monkeypatch, state, ready):
    """The check omits the reason: /readyz needs no key, and a reason may name a source."""
    source = "rtsp://10.0.0.5/x"
    view = StreamView(
        name="theatre", source=source, show="live", device="cpu", options={}, state=state, reason=f"{source} is gone"
    )
    monkeypatch.setattr(SupervisedStreams, "all", lambda self: [view])
    with tempfile.TemporaryDirectory(prefix="isp-") as runtime:
        settings = ServiceSettings(paths={"data": tmp_path, "runtime": runtime}, streams={})
        check = assembled(settings).checks["streams"]
        result = asyncio.run(check())
    assert (result.ok, result.needed) == (ready == "ready", False)
    assert "10.0.0.5" not in result.detail and (result.ok or result.detail == f"theatre: {state}")
