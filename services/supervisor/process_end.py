"""Descriptions and causes of process ends."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

from services.settings.sections import masked_address
from services.supervisor.exit_codes import NO_USE

_TAIL_BYTES = 4096
_LOGGED = re.compile(r"[\d-]+ [\d:,]+ (?P<level>[A-Z]+) [\w.]+: ")
"""Log line prefix of the stream processes."""


def ended_how(status: int) -> str:
    """Describe a wait status from `os.waitpid`."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return f"killed by {signal.Signals(number).name}"
    return f"exit code {os.waitstatus_to_exitcode(status)}"


def status_of_child(pid: int) -> str | None:
    """Describe the end of a child process. None if the process still runs or is not a child."""
    try:
        found, status = os.waitpid(pid, os.WNOHANG)
    except ChildProcessError:
        return None
    return ended_how(status) if found else None


def is_of_no_use(how: str | None) -> bool:
    """Return True if a restart would end in the same way."""
    return how == f"exit code {NO_USE}"


def cause_of(how: str) -> str:
    """Map the description of an end to one of few causes, for metric labels."""
    if how.endswith("it was killed"):
        return "hung"
    if how.startswith("killed by "):
        return how.removeprefix("killed by ")
    if is_of_no_use(how):
        return "refused"
    return how if how.startswith("exit code ") else "ended"


def last_words(log: Path) -> str:
    """Return the last logged error of a process, otherwise its last log line; empty without a log."""
    try:
        with open(log, "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES))
            lines = [line.strip() for line in file.read().decode(errors="replace").split("\n") if line.strip()]
    except FileNotFoundError:
        return ""
    errors = [index for index, line in enumerate(lines) if (match := _LOGGED.match(line)) and match["level"] == "ERROR"]
    if errors:
        more = lines[errors[-1] + 1 :]
        ends = next((index for index, line in enumerate(more) if _LOGGED.match(line)), len(more))
        lines = [" ".join([_LOGGED.sub("", lines[errors[-1]]), *more[:ends]])]
    return masked_address(_LOGGED.sub("", lines[-1]))[:500] if lines else ""
