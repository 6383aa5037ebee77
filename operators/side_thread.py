"""Priority of background threads, which use CPU time that the graph leaves idle."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress

NICENESS = 10
"""Nice value of a background thread."""


def step_back() -> None:
    """Lower the scheduling priority of the calling thread. No effect except on Linux."""
    if sys.platform == "linux":  # on other systems the nice value applies to the whole process
        with suppress(OSError):  # if not permitted, keep the normal priority
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
