"""Resource limits of processes that read uploads."""

from __future__ import annotations

import resource
from pathlib import Path

NICENESS = 10
"""Nice value of a check; running streams have priority."""


def taken_bytes() -> int:
    """Return the current size in bytes counted for RLIMIT_DATA."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    return int(fields["VmData"].split()[0]) * 1024


def lower_limit(kind: int, wanted: int, spare: int = 0) -> None:
    """Lower a resource limit; a lower existing limit is kept.

    Args:
        kind: resource, such as `resource.RLIMIT_CPU`.
        wanted: soft limit.
        spare: distance of the hard limit above the soft limit. For processor time, SIGXCPU comes at
            the soft limit.
    """
    _, hard = resource.getrlimit(kind)
    allowed = [wanted, wanted + spare]
    if hard != resource.RLIM_INFINITY:
        allowed = [min(each, hard) for each in allowed]
    resource.setrlimit(kind, (allowed[0], allowed[1]))
