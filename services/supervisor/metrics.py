"""Prometheus metrics of the streams, collected at scrape time from heartbeats. Labels hold the stream name and no other text of a request."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from prometheus_client import Metric
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.registry import Collector

from services.bus.messages import cumulative
from services.display import KINDS
from services.supervisor.process import StreamEvent

if TYPE_CHECKING:
    from services.supervisor.stream import SupervisedStreams


SOURCE_STATES = ("starting", "opening", "live", "stalled", "reconnecting", "lost", "ended", "failed", "down", "stopped")
LOST_BY_SOURCES = ("too_late", "bad_messages")
"""Counters of a source that count lost frames. Its other counters count defects that the source has repaired."""


class GraphFamilies:
    """Prometheus metric families of one scrape, filled by `add` stream by stream."""

    def __init__(self) -> None:
        of_stream = ["stream"]
        self._age = HistogramMetricFamily(
            "intrasplat_frame_age_seconds", "From a frame's arrival to the showing of its picture.", labels=of_stream
        )
        self._path = HistogramMetricFamily(
            "intrasplat_path_latency_seconds", "Through the engine's graph, by path.", labels=["stream", "path"]
        )
        self._operator = HistogramMetricFamily(
            "intrasplat_operator_duration_seconds", "One compute of an operator.", labels=["stream", "operator"]
        )
        self._queue = GaugeMetricFamily(
            "intrasplat_queue_depth", "Messages that wait between operators.", labels=["stream", "queue"]
        )
        self._frames = CounterMetricFamily(
            "intrasplat_frames", "Frames that got as far as this.", labels=["stream", "stage"]
        )
        self._dropped = CounterMetricFamily(
            "intrasplat_frames_dropped", "Frames that got no further.", labels=["stream", "reason"]
        )
        self._events = CounterMetricFamily(
            "intrasplat_source_events", "What a source repaired or went through.", labels=["stream", "role", "event"]
        )
        self._source = GaugeMetricFamily(
            "intrasplat_source_state", "1 for the state that a source is in.", labels=["stream", "state"]
        )
        self._gaussians = GaugeMetricFamily("intrasplat_gaussians", "Gaussians of the live scene.", labels=of_stream)
        self._steps = CounterMetricFamily("intrasplat_training_steps", "Optimiser steps.", labels=of_stream)
        self._model = GaugeMetricFamily(
            "intrasplat_model_info", "1 for what a stream shows.", labels=["stream", "show", "model", "version"]
        )

    def add(self, stream: str, processes: Mapping[str, Mapping[str, Any]], measures: Mapping[str, Any]) -> None:
        """Add a running stream: process states and engine measurements."""
        capture, engine = (processes.get(role, {}) for role in ("capture", "engine"))
        for each in SOURCE_STATES:
            self._source.add_metric([stream, each], float(capture.get("state") == each))
        self._add_counts(stream, capture.get("figures") or {}, engine.get("figures") or {})
        if engine.get("state") == "running":
            self._add_shown(stream, engine.get("figures") or {})
        if (ages := cumulative(measures.get("ages"))) is not None:
            self._age.add_metric([stream], *ages)
        for family, name in ((self._path, "paths"), (self._operator, "operators")):
            for label, value in _items(measures.get(name)):
                if (found := cumulative(value)) is not None:
                    family.add_metric([stream, label], *found)
        for queue, value in _items(measures.get("queues")):
            self._queue.add_metric([stream, queue], value["queued"])
            for reason, count in _items(value["dropped"]):
                self._dropped.add_metric([stream, f"{queue}: {reason}"], count)

    def families(self) -> Iterable[Metric]:
        """Return all families."""
        return [value for value in vars(self).values() if isinstance(value, Metric)]

    def _add_counts(self, stream: str, capture: Mapping[str, Any], engine: Mapping[str, Any]) -> None:
        stages = {"captured": capture.get("frames"), "trained": engine.get("trained"), "shown": engine.get("pictures")}
        stages["taken"] = engine.get("frames")
        for stage, count in stages.items():
            if count is not None:
                self._frames.add_metric([stream, stage], count)
        for role, counts in (("capture", capture.get("counts")), ("engine", engine.get("source_counts"))):
            for event, count in _items(counts):
                if event in LOST_BY_SOURCES:
                    self._dropped.add_metric([stream, f"{role}: {event}"], count)
                else:
                    self._events.add_metric([stream, role, event], count)
        if "passed_over" in engine:
            self._dropped.add_metric([stream, "passed over"], engine["passed_over"])
        for reason, count in _items(engine.get("withheld")):
            self._dropped.add_metric([stream, f"withheld: {reason}"], count)
        if "steps" in engine:
            self._steps.add_metric([stream], engine["steps"])
        if "gaussians" in engine:
            self._gaussians.add_metric([stream], engine["gaussians"])

    def _add_shown(self, stream: str, engine: Mapping[str, Any]) -> None:
        shown, model = engine.get("picture") or {}, engine.get("model") or {}
        if shown.get("show") == "model":
            self._model.add_metric([stream, "model", str(model.get("name", "")), str(model.get("version", ""))], 1)
        elif shown.get("show") == "live":
            # The live model's version changes with every frame, and each value would create a new
            # time series.
            self._model.add_metric([stream, "live", "", ""], 1)


def _items(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the items of a mapping in a heartbeat; nothing if a malformed heartbeat has another type."""
    if isinstance(value, Mapping):
        yield from value.items()


STATES = ("stopped", "starting", "live", "behind", "stale", "frozen", "source lost", "failed")


class StreamMeasures(Collector):
    """Collector for the streams; `count` receives process events."""

    streams: SupervisedStreams | None = None

    def __init__(self) -> None:
        self._events: Counter[tuple[str, str, str]] = Counter()

    def count(self, event: StreamEvent) -> None:
        """Count a process event."""
        self._events[event.stream, event.role, event.kind] += 1

    def collect(self) -> Iterable[Metric]:
        """Export the metrics of all streams at scrape time; see `Collector`."""
        state = GaugeMetricFamily(
            "intrasplat_stream_state", "1 for the state that a stream is in.", labels=["stream", "state"]
        )
        restarts = CounterMetricFamily(
            "intrasplat_process_restarts",
            "Times that a process ended and was started again.",
            labels=["stream", "role", "reason"],
        )
        events = CounterMetricFamily(
            "intrasplat_process_events", "What happened to processes.", labels=["stream", "role", "kind"]
        )
        encoded = CounterMetricFamily("intrasplat_pictures_encoded", "Pictures encoded.", labels=["stream", "picture"])
        dropped = CounterMetricFamily(
            "intrasplat_pictures_dropped", "Pictures that viewers missed.", labels=["stream", "picture", "reason"]
        )
        viewers = GaugeMetricFamily(
            "intrasplat_stream_viewers", "Number of open displays.", labels=["stream", "picture"]
        )
        ages = HistogramMetricFamily(
            "intrasplat_display_latency_seconds",
            "From a frame's arrival to when its picture was encoded for viewers.",
            labels=["stream", "picture"],
        )
        graphs = GraphFamilies()
        for stream in [] if self.streams is None else self.streams.streams():
            name, view, hub, processes = stream.name, stream.view(), stream.hub, stream.processes
            for each in STATES:
                state.add_metric([name, each], float(view.state == each))
            if hub is None:
                continue
            graphs.add(name, view.processes, processes["engine"].measures)
            for role, process in processes.items():
                for cause, count in process.causes.items():
                    restarts.add_metric([name, role, cause], count)
            for kind in KINDS:
                viewers.add_metric([name, kind], hub.viewers(kind))
                if (found := cumulative(hub.ages(kind))) is not None:
                    ages.add_metric([name, kind], *found)
                for reason, count in hub.counts(kind).items():
                    if reason == "encoded":
                        encoded.add_metric([name, kind], count)
                    else:
                        dropped.add_metric([name, kind, reason], count)
        for (name, of_role, what), count in self._events.items():
            events.add_metric([name, of_role, what], count)
        return [state, restarts, events, encoded, dropped, viewers, ages, *graphs.families()]
