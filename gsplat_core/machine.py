"""Resources of the machine: available memory, usable cores, torch's threads for one Python thread, and the priority of background threads.

LAPACK, BLAS and torch's reductions split long sums among threads, so rounding depends on the thread count. The solution
of a system with 200 unknowns, or the mean of 40,000 pixels, differs in its last bits between one and two threads.
Geometry runs such operations within `one_thread` to be reproducible.
"""

from __future__ import annotations

import ctypes
import os
import resource
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


def available_bytes() -> int | None:
    """Return the memory in bytes that the process can still allocate without swapping.

    This is the smallest of the system's available memory and the limits of control group and
    `ulimit -v`. None if unknown.
    """
    limits = [limit for limit in (_of_system(), _of_control_group(), _of_process()) if limit is not None]
    return min(limits) if limits else None


def peak_bytes() -> int:
    """Return the peak resident size of this process in bytes.

    Unlike `ru_maxrss`, the value of Linux does not include the parent process before `exec`.
    """
    for line in _text(Path("/proc/self/status")).splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def in_gib(count: int) -> str:
    """Format a number of bytes for display, such as "3.2 GiB"."""
    return f"{count / 2**30:.1f} GiB"


def _of_system(path: Path = Path("/proc/meminfo")) -> int | None:
    for line in _text(path).splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _of_control_group(folder: Path = Path("/sys/fs/cgroup")) -> int | None:
    limit, current = _text(folder / "memory.max").strip(), _text(folder / "memory.current").strip()
    if not limit.isdecimal() or not current.isdecimal():
        return None
    # A control group counts its page cache as used, but the kernel can reclaim it.
    stated = dict(line.split()[:2] for line in _text(folder / "memory.stat").splitlines() if " " in line)
    return max(0, int(limit) - int(current) + int(stated.get("inactive_file", "0")))


def _of_process(path: Path = Path("/proc/self/statm")) -> int | None:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    taken = _text(path).split()
    if limit == resource.RLIM_INFINITY or not taken:
        return None
    return max(0, limit - int(taken[0]) * resource.getpagesize())


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""  # the file does not exist on other systems, or if no such limit is set


def return_freed_memory() -> None:
    """Return freed heap pages to the operating system (glibc's `malloc_trim`); a no-op elsewhere.

    Takes milliseconds. Without it, the resident size of a long-running process grows through heap fragmentation.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def usable_cores() -> int:
    """Return the number of CPU cores on which this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_one_thread() -> None:
    """Limit torch operations of the calling thread to one core permanently.

    torch stores the number per thread, and as the default of threads that have not computed yet.
    Another thread restores that default.
    """
    import torch  # imported only here, because the control plane uses this module without torch

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
    import torch

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
"""Nice value (lower scheduling priority) that `step_back` gives a background thread on Linux."""


def step_back() -> None:
    """Lower the scheduling priority of the calling thread. No effect except on Linux."""
    # On systems other than Linux, the nice value applies to the whole process instead of one thread.
    if sys.platform == "linux":
        with suppress(OSError):  # the thread keeps the normal priority if a change is not permitted
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
