"""Log output of the service on standard error."""

from __future__ import annotations

import io
import logging
import sys
from collections.abc import Iterator

import pytest

from services.api.observability import TextFormatter, facts, log_to_stderr
from services.settings.sections import LogSettings


class Terminal(io.StringIO):
    """Says that it is one."""

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
def test_a_terminal_gets_text_and_everything_else_json_unless_the_settings_say_which(
    monkeypatch: pytest.MonkeyPatch, stream: type[io.StringIO], form: str, json: bool
) -> None:
    monkeypatch.setattr(sys, "stderr", written := stream())
    log_to_stderr(LogSettings.model_validate({"format": form}))

    logging.getLogger("services").warning("a stream stopped", extra=facts(stream="room-1"))

    assert written.getvalue().startswith("{") is json
    assert "a stream stopped" in written.getvalue() and "room-1" in written.getvalue()


def test_text_hides_passwords_and_cannot_be_made_to_hold_a_second_line() -> None:
    record = logging.makeLogRecord(
        {"msg": "rtsp://user:secret@camera/\n12:00:00 info forged", "levelname": "INFO", **facts(source="a\nb")}
    )

    line = TextFormatter().format(record)

    assert "secret" not in line and "\n" not in line
