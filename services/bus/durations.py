"""Duration histograms with buckets at multiples of the frame interval, small enough for heartbeats."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

BOUNDS_S = (0.001, 0.0025, 0.005, 0.0083, 0.0167, 0.025, 0.0333, 0.05, 0.0667, 0.1, 0.15, 0.25, 0.5, 1.0, 5.0)
"""Upper bounds in seconds: 8.3, 16.7, 33.3, 50 and 66.7 ms are one and two frames at 120, 60 and 30
frames/s. Longer durations have their own bucket."""


class Durations:
    """Histogram of one kind of duration. One thread adds; another thread may read counts that lag
    by at most one."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def add(self, duration_s: float) -> None:
        """Count one duration."""
        self._counts[bisect_left(BOUNDS_S, duration_s)] += 1
        self._sum_s += duration_s

    def told(self) -> dict[str, Any]:
        """Return the JSON form: the count of each bucket, the last without an upper bound, and the
        sum."""
        return {"counts": list(self._counts), "sum_s": round(self._sum_s, 6)}


def cumulative(told: Any) -> tuple[list[tuple[str, float]], float] | None:
    """Convert the durations of a heartbeat to Prometheus buckets and their sum; None for malformed
    values."""
    counts = told.get("counts") if isinstance(told, Mapping) else None
    sum_s = told.get("sum_s") if isinstance(told, Mapping) else None
    whole = (
        isinstance(counts, list) and len(counts) == len(BOUNDS_S) + 1 and all(type(count) is int for count in counts)
    )
    if not whole or not isinstance(sum_s, int | float) or counts is None:
        return None
    found, total = [], 0
    for bound, count in zip((*map(str, BOUNDS_S), "+Inf"), counts, strict=True):
        total += count
        found.append((bound, float(total)))
    return found, float(sum_s)
