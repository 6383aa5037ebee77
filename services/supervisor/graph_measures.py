"""Metrics of a graph for the engine's heartbeats."""

from __future__ import annotations

from typing import Any

from operators.graph.application import Application
from operators.graph.tracking import Histogram
from services.bus.messages import BOUNDS_S

BOUNDS_NS = tuple(round(bound_s * 1e9) for bound_s in BOUNDS_S)


def graph_measures(graph: Application) -> dict[str, Any]:
    """Return path latencies, operator durations, and queue lengths and drops of a graph."""
    tracker = graph.track()
    return {
        "paths": {name: _serialised(histogram) for name, histogram in tracker.paths().items()},
        "operators": {name: _serialised(histogram) for name, histogram in tracker.operators().items()},
        "queues": {stats.edge: {"queued": stats.queued, "dropped": stats.dropped} for stats in graph.edge_stats()},
    }


def _serialised(histogram: Histogram) -> dict[str, Any]:
    """Return a histogram in the format of `services.bus.messages.Durations`."""
    return {"counts": histogram.between(BOUNDS_NS), "sum_s": round(histogram.sum_ns * 1e-9, 6)}
