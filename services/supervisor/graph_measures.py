"""What a graph has measured, for the engine's heartbeats."""

from __future__ import annotations

from typing import Any

from operators.graph.application import Application
from operators.graph.tracking import Histogram
from services.bus.durations import BOUNDS_S

BOUNDS_NS = tuple(round(bound_s * 1e9) for bound_s in BOUNDS_S)


def graph_measures(graph: Application) -> dict[str, Any]:
    """Latencies of its paths, durations of its operators, and what waits in its queues and was dropped from them."""
    tracker = graph.track()
    return {
        "paths": {name: _told(histogram) for name, histogram in tracker.paths().items()},
        "operators": {name: _told(histogram) for name, histogram in tracker.operators().items()},
        "queues": {stats.edge: {"queued": stats.queued, "dropped": stats.dropped} for stats in graph.edge_stats()},
    }


def _told(histogram: Histogram) -> dict[str, Any]:
    """As `services.bus.durations.Durations` tells its own."""
    return {"counts": histogram.between(BOUNDS_NS), "sum_s": round(histogram.sum_ns * 1e-9, 6)}
