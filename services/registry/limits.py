"""Resource budgets of uploads and their checks, and resource limits of the processes that read uploads."""

from __future__ import annotations

import resource
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
