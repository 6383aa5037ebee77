"""Which process waits when there is not enough of the machine for all."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

ENGINE_ON_CPU = 5
"""An engine that trains on the CPU takes all that it is given; frames, viewers and commands come first, and take little."""


def step_back(nice: int) -> None:
    """Let processes of usual priority go first.

    Where Linux groups processes by session (`sched_autogroup_enabled`), nice values count within a session only, and each process of a stream has one
    of its own: the session steps back, too.
    """
    os.nice(max(0, nice - os.nice(0)))
    with contextlib.suppress(OSError):  # no such groups here, or nothing may be written in this container
        Path("/proc/self/autogroup").write_text(str(nice), encoding="ascii")
