"""What a process that reads an upload may take of the machine."""

from __future__ import annotations

import resource
from pathlib import Path

NICENESS = 10
"""Streams that run on this machine go before a check."""


def taken_bytes() -> int:
    """What the system counts for RLIMIT_DATA at this moment."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    return int(fields["VmData"].split()[0]) * 1024


def lower_limit(kind: int, wanted: int, spare: int = 0) -> None:
    """Set a limit, unless there is a lower one. spare: between the warning (of processor time: SIGXCPU) and the end."""
    _, hard = resource.getrlimit(kind)
    allowed = [wanted, wanted + spare]
    if hard != resource.RLIM_INFINITY:
        allowed = [min(each, hard) for each in allowed]
    resource.setrlimit(kind, (allowed[0], allowed[1]))
