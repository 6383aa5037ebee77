"""Flow tracking: latency from root to leaf and compute durations, readable during a run.

Memory is bounded: durations are kept in histograms of fixed size, one per path and operator. Each
histogram has one writer, because an operator computes in one thread at a time. No locks are needed.
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
"""Maximum number of tracked paths per message; a chain of k diamonds has 2^k paths."""


@dataclass(frozen=True)
class DurationSummary:
    """Number and percentiles of durations in milliseconds, at most 3.2 % above the true values; `max_ms` is exact."""

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
        """Count one duration in nanoseconds; it is limited to 4.9 h."""
        if duration_ns > self._max_ns:
            self._max_ns = duration_ns
        self._sum_ns += max(duration_ns, 0)
        self._counts[_bucket(min(max(duration_ns, 0), _LONGEST_NS))] += 1

    def summary(self) -> DurationSummary:
        """Return the percentiles so far. Thread-safe."""
        p50_ms, p95_ms, p99_ms = self.quantiles_ms((0.50, 0.95, 0.99))
        return DurationSummary(sum(self._counts), p50_ms, p95_ms, p99_ms, self._max_ns * 1e-6)

    @property
    def sum_ns(self) -> int:
        """Sum of all durations in nanoseconds."""
        return self._sum_ns

    def between(self, bounds_ns: Sequence[int]) -> list[int]:
        """Return the number of durations between consecutive bounds. Thread-safe.

        Args:
            bounds_ns: ascending upper bounds in nanoseconds. A bucket that contains a bound counts as below it.

        Returns:
            One count per bound, and the count above the last one.
        """
        counts = self._counts.copy()
        ends = [0, *(_bucket(min(bound_ns, _LONGEST_NS)) + 1 for bound_ns in bounds_ns), len(counts)]
        return [sum(counts[begin:end]) for begin, end in itertools.pairwise(ends)]

    def quantiles_ms(self, fractions: Sequence[float]) -> list[float]:
        """Return quantiles in milliseconds. Thread-safe.

        Args:
            fractions: ascending quantile levels, 0..1.
        """
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
    """Return the rank of a quantile among `total` values, rounded up with a tolerance for float errors."""
    return math.ceil(fraction * total - 1e-9 * total)


def _bucket(value: int) -> int:
    shift = value.bit_length() - _SUB_BITS - 1
    return value if shift <= 0 else (shift << _SUB_BITS) + (value >> shift)


def _bucket_end(bucket: int) -> int:
    shift = max((bucket >> _SUB_BITS) - 1, 0)
    return ((bucket - (shift << _SUB_BITS) + 1) << shift) - 1


class PathNode:
    """An operator on a path from a root. The nodes form a tree, so that a path is one reference."""

    __slots__ = ("_children", "latency", "names")

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self.latency: Histogram | None = None
        self._children: dict[str, PathNode] = {}

    def child(self, name: str) -> PathNode | None:
        """Return the path extended by one operator; None if the operator is already on it (a cycle)."""
        node = self._children.get(name)
        if node is None and name not in self.names:
            node = self._children[name] = PathNode((*self.names, name))
        return node


Trail = tuple[tuple[PathNode, int], ...]
"""Paths that a message took, each with the start time of its root's compute in nanoseconds."""


class FlowTracker:
    """Latencies of all root-to-leaf paths and compute durations of all operators.

    A path begins when a compute without received messages emits. It ends when an operator without connected outputs
    returns from the compute that received the message. Times are real times of the machine's clock, also in a replay.
    """

    def __init__(self) -> None:
        self._roots: dict[str, PathNode] = {}
        self._paths: dict[str, Histogram] = {}
        self._computes: dict[str, Histogram] = {}

    def reset(self) -> None:
        """Clear all data; called at the start of a run."""
        self._roots, self._paths, self._computes = {}, {}, {}

    def paths(self) -> dict[str, Histogram]:
        """Return the latency histogram of each path. Thread-safe."""
        return self._paths.copy()

    def operators(self) -> dict[str, Histogram]:
        """Return the histogram of compute durations of each operator. Thread-safe."""
        return self._computes.copy()

    def latency(self) -> dict[str, DurationSummary]:
        """Return the latency by path, for example `source,depth,display`. Thread-safe."""
        return {path: histogram.summary() for path, histogram in self._paths.copy().items()}

    def latency_quantiles_ms(self, fractions: Sequence[float]) -> dict[str, list[float]]:
        """Return the latency quantiles in milliseconds by path, at ascending levels 0..1. Thread-safe."""
        return {path: histogram.quantiles_ms(fractions) for path, histogram in self._paths.copy().items()}

    def compute(self) -> dict[str, DurationSummary]:
        """Return the compute durations by operator. Thread-safe."""
        return {name: histogram.summary() for name, histogram in self._computes.copy().items()}

    def operator(self, name: str) -> Histogram:
        """Return the histogram for an operator's compute durations, created on first use."""
        return self._computes.setdefault(name, Histogram())

    def begin(self, operator: str, began_ns: int) -> Trail:
        """Return the trail (paths and their start times) of a message from an operator that had received none (a root)."""
        root = self._roots.get(operator)
        if root is None:
            root = self._roots[operator] = PathNode((operator,))
        return ((root, began_ns),)

    def extend(self, operator: str, trails: list[Trail]) -> Trail:
        """Return the trail of a message emitted after receiving messages with `trails`; keeps the oldest time per path."""
        merged: dict[PathNode, int] = {}
        for trail in trails:
            for node, began_ns in trail:
                child = node.child(operator)
                if child is not None and began_ns < merged.get(child, began_ns + 1) and len(merged) < _MAX_TRAILS:
                    merged[child] = began_ns
        return tuple(merged.items())

    def finish(self, operator: str, trails: list[Trail]) -> None:
        """Record the time since the start of each path of the messages that an operator without connected outputs (a leaf) has
        processed.
        """
        now_ns = perf_counter_ns()
        for trail in trails:
            for node, began_ns in trail:
                leaf = node.child(operator)
                if leaf is None:
                    continue
                if leaf.latency is None:
                    leaf.latency = self._paths[",".join(leaf.names)] = Histogram()
                leaf.latency.record(now_ns - began_ns)
