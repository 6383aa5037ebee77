"""Number of usable cores, and a limit on the number of threads that torch uses for operations called from one Python thread.

LAPACK, BLAS and torch's reductions split long sums among threads, so rounding depends on the thread count. The solution
of a system with 200 unknowns, or the mean of 40,000 pixels, differs in its last bits between one and two threads.
Geometry runs such operations within `one_thread` to be reproducible.

Priority of background threads, which use CPU time that the graph leaves idle.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import torch


def usable_cores() -> int:
    """Number of CPU cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_one_thread() -> None:
    """Limit torch operations of the calling thread to one core permanently.

    torch stores the number per thread, and as the default of threads that have not computed yet.
    Another thread restores that default.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    other = threading.Thread(target=torch.set_num_threads, args=(before,))
    other.start()
    other.join()


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch operations of the calling thread to one core within a block or decorated function.

    Results then do not depend on the number of cores. Nested use costs nothing. The outermost use takes about 0.1 ms.
    """
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    use_one_thread()
    try:
        yield
    finally:
        torch.set_num_threads(before)


NICENESS = 10
"""Nice value of a background thread."""


def step_back() -> None:
    """Lower the scheduling priority of the calling thread. No effect except on Linux."""
    if sys.platform == "linux":  # on other systems the nice value applies to the whole process
        with suppress(OSError):  # if not permitted, keep the normal priority
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
