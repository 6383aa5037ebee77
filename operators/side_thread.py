"""A thread beside the graph: it takes what the graph leaves of the processor."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress

import torch

NICENESS = 10
"""How far such a thread steps back behind the graph where both want the processor."""


def step_back() -> None:
    """Let the calling thread step back behind the others of this process, where the system knows priorities of threads."""
    if sys.platform == "linux":  # elsewhere it means the whole process
        with suppress(OSError):  # a system that does not allow it lets the thread run as all others do
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


def use_one_core() -> None:
    """Let what the calling thread computes with torch, or by our own kernels, take one core; other threads go on with as many as before.

    torch sets the number for the thread that asks and for those that have not computed yet: for these another thread sets it back.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    other = threading.Thread(target=torch.set_num_threads, args=(before,))
    other.start()
    other.join()


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
