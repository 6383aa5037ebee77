"""Resource budgets of uploads and their checks, and resource limits of the processes that read uploads."""

from __future__ import annotations

import math
import os
import resource
import time
from pathlib import Path

GIB = 1 << 30


MOST_UPLOAD_BYTES = 4 * GIB
"""Default for the largest upload in bytes."""
MOST_GAUSSIANS = 2_000_000
MOST_TENSOR_BYTES = 4 * GIB
"""Largest total size of the tensors in memory, in bytes."""
MOST_PIXELS = 4096 * 4096
"""Largest picture of the model's camera, in pixels."""
CHECK_MEMORY_BYTES = 12 * GIB
"""Memory of the checking process beyond torch itself, in bytes."""
CHECK_S = 120.0
"""Processor time of the check in seconds, without the start of torch. Exceeding it rejects the version."""
CHECK_PASSED_S = 600.0
"""Wall-clock time of a check in seconds, including process start. Exceeding it means that the machine is too busy, and the
version is not rejected.
"""
NICENESS = 10
"""Nice value of a check; running streams have priority."""


def taken_bytes() -> int:
    """Return this process's current data size in bytes, as counted for RLIMIT_DATA."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    return int(fields["VmData"].split()[0]) * 1024


def lower_limit(kind: int, wanted: int, spare: int = 0) -> None:
    """Lower a resource limit; a lower existing limit is kept.

    Args:
        kind: resource, such as `resource.RLIMIT_CPU`.
        wanted: soft limit.
        spare: distance of the hard limit above the soft limit. For processor time, SIGXCPU comes at the soft limit.
    """
    _, hard = resource.getrlimit(kind)
    allowed = [wanted, wanted + spare]
    if hard != resource.RLIM_INFINITY:
        allowed = [min(each, hard) for each in allowed]
    resource.setrlimit(kind, (allowed[0], allowed[1]))


def limit_resources(device: str) -> None:
    """Limit processor time and memory beyond what torch used at its start, and disable core files.

    Memory is not limited on CUDA, which maps far more address space than it uses.
    """
    os.nice(NICENESS)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if device == "cpu":
        lower_limit(resource.RLIMIT_DATA, taken_bytes() + CHECK_MEMORY_BYTES)
    lower_limit(resource.RLIMIT_CPU, math.ceil(time.process_time() + CHECK_S), spare=5)


_MEMORY_WORDS = ("can't allocate memory", "cannot allocate memory", "out of memory", "bad_alloc")


def says_out_of_memory(error: Exception) -> bool:
    """Return True for a MemoryError, and for the RuntimeError that torch's allocators raise in place of it."""
    return not isinstance(error, RuntimeError) or any(words in str(error).lower() for words in _MEMORY_WORDS)
