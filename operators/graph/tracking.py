"""Flow tracking: how long messages take from root to leaf and operators to compute, readable while running.

Memory is bounded: durations go into histograms of fixed size, and there are at most as many as paths and operators.
Each histogram has one writer (an operator computes in one thread at a time), so nothing is locked.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter_ns

_SUB_BITS = 5
_LONGEST_NS = (1 << 44) - 1  # 4.9 h
_MAX_TRAILS = 64
"""Paths followed per message: a chain of k diamonds has 2^k of them."""


@dataclass(frozen=True)
class DurationSummary:
    """Percentiles in milliseconds, at most 3.2 % above the true ones; `max_ms` is exact."""

    count: int
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class Histogram:
    """Durations in buckets of 1/32 of an octave, after HdrHistogram (G. Tene)."""

    __slots__ = ("_counts", "_max_ns", "_sum_ns")

    def __init__(self) -> None:
        self._counts = [0] * (_bucket(_LONGEST_NS) + 1)
        self._max_ns = self._sum_ns = 0

    def record(self, duration_ns: int) -> None:
        """Count one duration; beyond 4.9 h it counts as 4.9 h."""
        if duration_ns > self._max_ns:
            self._max_ns = duration_ns
        self._sum_ns += max(duration_ns, 0)
        self._counts[_bucket(min(max(duration_ns, 0), _LONGEST_NS))] += 1

    def summary(self) -> DurationSummary:
        """The percentiles so far; from any thread."""
        p50_ms, p95_ms, p99_ms = self.quantiles_ms((0.50, 0.95, 0.99))
        return DurationSummary(sum(self._counts), p50_ms, p95_ms, p99_ms, self._max_ns * 1e-6)

    @property
    def sum_ns(self) -> int:
        """All durations together."""
        return self._sum_ns

    def between(self, bounds_ns: Sequence[int]) -> list[int]:
        """How many durations lie up to each of these bounds (ascending) and above the one before it, and how many above the last; a bucket that a
        bound cuts counts as below it. From any thread."""
        counts = self._counts.copy()
        ends = [0, *(_bucket(min(bound_ns, _LONGEST_NS)) + 1 for bound_ns in bounds_ns), len(counts)]
        return [sum(counts[begin:end]) for begin, end in itertools.pairwise(ends)]

    def quantiles_ms(self, fractions: Sequence[float]) -> list[float]:
        """The durations that these shares (ascending, 0..1) of all do not exceed, in milliseconds; from any thread."""
        max_ns = self._max_ns
        counts = self._counts.copy()
        total = sum(counts)
        values: list[float] = []
        reached = 0
        for bucket, count in enumerate(counts):
            reached += count
            while count and len(values) < len(fractions) and reached >= _rank(fractions[len(values)], total):
                values.append(min(_bucket_end(bucket), max_ns) * 1e-6)
        return values + [0.0] * (len(fractions) - len(values))


def _rank(fraction: float, total: int) -> int:
    """How many of `total` values a share of them is, rounded up; 0.07 of 100 is 7, though its product in floats is a little more."""
    return math.ceil(fraction * total - 1e-9 * total)


def _bucket(value: int) -> int:
    shift = value.bit_length() - _SUB_BITS - 1
    return value if shift <= 0 else (shift << _SUB_BITS) + (value >> shift)


def _bucket_end(bucket: int) -> int:
    shift = max((bucket >> _SUB_BITS) - 1, 0)
    return ((bucket - (shift << _SUB_BITS) + 1) << shift) - 1


class PathNode:
    """One operator on a path from a root; the nodes of all paths form a tree, so that a path is one reference."""

    __slots__ = ("_children", "latency", "names")

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self.latency: Histogram | None = None
        self._children: dict[str, PathNode] = {}

    def child(self, name: str) -> PathNode | None:
        """The path one operator longer; None in a loop, which is not followed round."""
        node = self._children.get(name)
        if node is None and name not in self.names:
            node = self._children[name] = PathNode((*self.names, name))
        return node


Trail = tuple[tuple[PathNode, int], ...]
"""The paths by which a message has come, each with the time at which its root began to compute."""


class FlowTracker:
    """Latency of every root→leaf path and durations of every operator's compute.

    A path begins when a compute that received nothing emits, and ends when an operator without connected outputs
    returns from the compute that received the message. Times are of the machine's clock, also in replay.
    """

    def __init__(self) -> None:
        self._roots: dict[str, PathNode] = {}
        self._paths: dict[str, Histogram] = {}
        self._computes: dict[str, Histogram] = {}

    def reset(self) -> None:
        """Forget everything; run() begins so."""
        self._roots, self._paths, self._computes = {}, {}, {}

    def paths(self) -> dict[str, Histogram]:
        """Per path, its latencies; from any thread."""
        return self._paths.copy()

    def operators(self) -> dict[str, Histogram]:
        """Per operator, the durations of its computes; from any thread."""
        return self._computes.copy()

    def latency(self) -> dict[str, DurationSummary]:
        """Per path, named `source,depth,display`; from any thread."""
        return {path: histogram.summary() for path, histogram in self._paths.copy().items()}

    def latency_quantiles_ms(self, fractions: Sequence[float]) -> dict[str, list[float]]:
        """Per path, the latencies at these shares (ascending, 0..1): the distribution as a curve; from any thread."""
        return {path: histogram.quantiles_ms(fractions) for path, histogram in self._paths.copy().items()}

    def compute(self) -> dict[str, DurationSummary]:
        """Per operator, by name; from any thread."""
        return {name: histogram.summary() for name, histogram in self._computes.copy().items()}

    def operator(self, name: str) -> Histogram:
        """Where an operator's compute durations go."""
        return self._computes.setdefault(name, Histogram())

    def begin(self, operator: str, began_ns: int) -> Trail:
        """The trail of what a root emits."""
        root = self._roots.get(operator)
        if root is None:
            root = self._roots[operator] = PathNode((operator,))
        return ((root, began_ns),)

    def extend(self, operator: str, trails: list[Trail]) -> Trail:
        """The trail of what an operator emits after it received messages with these trails; the oldest per path."""
        merged: dict[PathNode, int] = {}
        for trail in trails:
            for node, began_ns in trail:
                child = node.child(operator)
                if child is not None and began_ns < merged.get(child, began_ns + 1) and len(merged) < _MAX_TRAILS:
                    merged[child] = began_ns
        return tuple(merged.items())

    def finish(self, operator: str, trails: list[Trail]) -> None:
        """A leaf has computed: its messages have arrived."""
        now_ns = perf_counter_ns()
        for trail in trails:
            for node, began_ns in trail:
                leaf = node.child(operator)
                if leaf is None:
                    continue
                if leaf.latency is None:
                    leaf.latency = self._paths[",".join(leaf.names)] = Histogram()
                leaf.latency.record(now_ns - began_ns)
