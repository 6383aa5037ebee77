"""The distribution of ages, in memory of fixed size."""

from __future__ import annotations

import math
from dataclasses import dataclass

_FINEST_MS = 1e-3
_RATIO = 1.01
_BUCKETS = 2600
"""From a microsecond to two days."""


@dataclass(frozen=True)
class Ages:
    """How old what was shown was, in milliseconds; percentiles are at most 1 % too high, `max_ms` is exact."""

    count: int
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class AgeHistogram:
    """Takes ages one at a time, into buckets of 1 %."""

    def __init__(self) -> None:
        self._counts = [0] * _BUCKETS
        self._max_ms = 0.0

    def add(self, age_ms: float) -> None:
        """Take one age in milliseconds; below a microsecond counts as one."""
        self._max_ms = max(self._max_ms, age_ms)
        place = math.ceil(math.log(max(age_ms, _FINEST_MS) / _FINEST_MS) / math.log(_RATIO) - 1e-9)
        self._counts[min(place, _BUCKETS - 1)] += 1

    def ages(self) -> Ages | None:
        """The distribution so far; None without any age."""
        count = sum(self._counts)
        if not count:
            return None
        p50_ms, p95_ms, p99_ms = (self._quantile(share, count) for share in (0.50, 0.95, 0.99))
        return Ages(count, p50_ms, p95_ms, p99_ms, self._max_ms)

    def _quantile(self, share: float, count: int) -> float:
        """The age that this share of all does not exceed."""
        reached = 0
        for place, here in enumerate(self._counts):
            reached += here
            if reached >= share * count - 1e-9 * count:
                return min(_FINEST_MS * _RATIO**place, self._max_ms)
        return self._max_ms
