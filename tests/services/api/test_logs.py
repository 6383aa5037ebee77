"""Log output of the service on standard error."""

from __future__ import annotations

import io
import logging
import sys
import threading
from collections.abc import Iterator

import pytest

from services.api import observability
from services.api.observability import FACTS, TextFormatter, _log_uncaught, log_to_stderr
from services.settings import LogSettings


class Terminal(io.StringIO):
    """Standard error that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def loggers_as_they_were() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers, root.level = handlers, level


@pytest.mark.parametrize(
    ("stream", "form", "json"),
    [(Terminal, "auto", False), (io.StringIO, "auto", True), (Terminal, "json", True), (io.StringIO, "text", False)],
)
def test_log_format_auto_is_text_on_terminal_and_json_elsewhere(
    monkeypatch: pytest.MonkeyPatch, stream: type[io.StringIO], form: str, json: bool
) -> None:
    monkeypatch.setattr(sys, "stderr", written := stream())
    log_to_stderr(LogSettings.model_validate({"format": form}))

    logging.getLogger("services").warning("a stream stopped", extra={FACTS: {"stream": "room-1"}})

    assert written.getvalue().startswith("{") is json
    assert "a stream stopped" in written.getvalue() and "room-1" in written.getvalue()


def test_text_formatter_hides_passwords_and_newlines() -> None:
    record = logging.makeLogRecord(
        {"msg": "rtsp://user:secret@camera/\n12:00:00 info forged", "levelname": "INFO", FACTS: {"source": "a\nb"}}
    )

    line = TextFormatter().format(record)

    assert "secret" not in line and "\n" not in line


@pytest.mark.parametrize(
    ("kind", "error", "is_logged"),
    [(ValueError, ValueError("broken"), True), (KeyboardInterrupt, KeyboardInterrupt(), True), (SystemExit, SystemExit(2), False), (ValueError, None, False)],
)  # fmt: skip
def test_log_uncaught_logs_errors_except_system_exit(
    caplog: pytest.LogCaptureFixture, kind: type[BaseException], error: BaseException | None, is_logged: bool
) -> None:
    _log_uncaught(kind, error, None)
    assert [record.levelname for record in caplog.records] == ["CRITICAL"] * is_logged
    if is_logged:
        assert caplog.records[0].exc_info is not None and caplog.records[0].exc_info[1] is error


def test_log_to_stderr_installs_exception_hooks_and_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[object] = []
    monkeypatch.setattr(sys, "excepthook", None)
    monkeypatch.setattr(threading, "excepthook", None)
    monkeypatch.setattr(observability, "_log_uncaught", lambda *given: logged.append(given))
    access, error = logging.getLogger("uvicorn.access"), logging.getLogger("uvicorn.error")
    monkeypatch.setattr(access, "disabled", False)
    monkeypatch.setattr(error, "filters", [])
    log_to_stderr(LogSettings.model_validate({"level": "warning"}))
    assert sys.excepthook is observability._log_uncaught
    raised = ValueError("broken")
    threading.excepthook(threading.ExceptHookArgs((ValueError, raised, None, None)))
    assert logged == [(ValueError, raised, None)]
    assert access.disabled and len(error.filters) == 1 and logging.getLogger().level == logging.WARNING
    assert logging.getLogger("alembic").level == logging.getLogger("websockets").level == logging.WARNING
