"""A thread beside the graph: it takes what the graph leaves of the processor."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress

NICENESS = 10
"""How far such a thread steps back behind the graph where both want the processor."""


def step_back() -> None:
    """Let the calling thread step back behind the others of this process, where the system knows priorities of threads."""
    if sys.platform == "linux":  # elsewhere it means the whole process
        with suppress(OSError):  # a system that does not allow it lets the thread run as all others do
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
