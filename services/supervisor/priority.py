"""Process priorities for machines under full load."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

ENGINE_ON_CPU = 5
"""Nice value of an engine that trains on the CPU, which uses all available time. Capture, viewers
and commands need little and run first."""


def step_back(nice: int) -> None:
    """Lower the priority of this process.

    With `sched_autogroup_enabled` Linux applies nice values only within a session, and each stream
    process has its own session. The session's priority is therefore lowered too.

    Args:
        nice: nice value to reach.
    """
    os.nice(max(0, nice - os.nice(0)))
    with contextlib.suppress(OSError):  # no autogroups on this system, or read-only in this container
        Path("/proc/self/autogroup").write_text(str(nice), encoding="ascii")
