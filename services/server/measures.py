"""Prometheus metrics of the streams, collected at scrape time. Labels hold the stream name and no
patient data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING

from prometheus_client import Metric
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.registry import Collector

from services.bus.messages import cumulative
from services.bus.runtime import ROLES
from services.display.hub import KINDS
from services.server.graph_measures import GraphFamilies
from services.supervisor.process import StreamEvent

if TYPE_CHECKING:
    from services.server.streams import SupervisedStreams

STATES = ("stopped", "starting", "live", "stale", "frozen", "source lost", "failed")


class StreamMeasures(Collector):
    """Collector for the streams; `count` receives process events."""

    streams: SupervisedStreams | None = None

    def __init__(self) -> None:
        self._events: Counter[tuple[str, str, str]] = Counter()

    def count(self, event: StreamEvent) -> None:
        """Count a process event."""
        self._events[event.stream, event.role, event.kind] += 1

    def collect(self) -> Iterable[Metric]:
        """See `Collector`."""
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
        viewers = GaugeMetricFamily("intrasplat_stream_viewers", "Open displays.", labels=["stream", "picture"])
        ages = HistogramMetricFamily(
            "intrasplat_display_latency_seconds",
            "From a frame's arrival to when its picture was encoded for viewers.",
            labels=["stream", "picture"],
        )
        graphs = GraphFamilies()
        for facts in [] if self.streams is None else self.streams.now():
            for each in STATES:
                state.add_metric([facts.name, each], float(facts.state == each))
            hub = self.streams.hub(facts.name) if self.streams is not None else None
            if hub is None or self.streams is None:
                continue
            graphs.add(facts.name, facts.processes, self.streams.measures(facts.name, "engine"))
            for role in ROLES:
                for cause, count in self.streams.causes(facts.name, role).items():
                    restarts.add_metric([facts.name, role, cause], count)
            for kind in KINDS:
                viewers.add_metric([facts.name, kind], hub.viewers(kind))
                if (found := cumulative(hub.ages(kind))) is not None:
                    ages.add_metric([facts.name, kind], *found)
                for reason, count in hub.counts(kind).items():
                    if reason == "encoded":
                        encoded.add_metric([facts.name, kind], count)
                    else:
                        dropped.add_metric([facts.name, kind, reason], count)
        for (stream, of_role, what), count in self._events.items():
            events.add_metric([stream, of_role, what], count)
        return [state, restarts, events, encoded, dropped, viewers, ages, *graphs.families()]
