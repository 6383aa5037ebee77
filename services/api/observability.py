"""Service log, and Prometheus metrics of the control plane and of the streams.

The log is on standard error, one line per event, with the request id. Labels of metrics hold route templates and stream names, and no other
text of a request. Metrics of streams are collected from heartbeats at scrape time.
"""

from __future__ import annotations

import collections
import json
import logging
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from datetime import UTC, datetime
from types import TracebackType
from typing import TYPE_CHECKING, Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, Metric
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from services import product_version
from services.bus.messages import cumulative
from services.display import KINDS
from services.settings import LogSettings, masked_address
from services.supervisor.process import StreamEvent

if TYPE_CHECKING:
    from services.supervisor.stream import SupervisedStreams

REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
FACTS = "facts"
"""Name of the further fields of a log line: `log.info("…", extra={FACTS: {"route": "/v1/models"}})`."""


class JsonFormatter(logging.Formatter):
    """Log formatter for one JSON object per line. Escapes line breaks, so clients cannot forge
    lines, and masks passwords in addresses."""

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": masked_address(record.getMessage()),
        }
        if REQUEST_ID.get():
            entry["request_id"] = REQUEST_ID.get()
        entry.update(getattr(record, FACTS, {}))
        if record.exc_info:
            entry["exception"] = masked_address(self.formatException(record.exc_info))
        return json.dumps(entry, ensure_ascii=True, default=str)


class TextFormatter(logging.Formatter):
    """Log formatter for terminals. Masks passwords in addresses and escapes line breaks of messages."""

    def format(self, record: logging.LogRecord) -> str:
        time = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        line = f"{time} {record.levelname.lower():7} {masked_address(record.getMessage())}"
        line += "".join(f" {name}={value}" for name, value in getattr(record, FACTS, {}).items())
        line = line.replace("\r", "\\r").replace("\n", "\\n")
        return f"{line}\n{masked_address(self.formatException(record.exc_info))}" if record.exc_info else line


def log_to_stderr(settings: LogSettings) -> None:
    """Send the records of all loggers of this process to standard error."""
    handler = logging.StreamHandler()
    text = settings.format == "text" or (settings.format == "auto" and handler.stream.isatty())
    handler.setFormatter(TextFormatter() if text else JsonFormatter())
    logging.basicConfig(level=settings.level.upper(), handlers=[handler], force=True)
    logging.captureWarnings(True)
    sys.excepthook = _log_uncaught
    threading.excepthook = lambda raised: _log_uncaught(raised.exc_type, raised.exc_value, raised.exc_traceback)
    logging.getLogger("uvicorn.access").disabled = True  # its lines contain addresses with tickets
    logging.getLogger("uvicorn.error").addFilter(_is_no_refused_websocket)
    for chatty in ("websockets", "alembic"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


def _log_uncaught(kind: type[BaseException], error: BaseException | None, trace: TracebackType | None) -> None:
    """Log an uncaught exception, except SystemExit, in the format of the log."""
    if error is not None and not issubclass(kind, SystemExit):
        logging.getLogger("intrasplat").critical("an error that nothing has caught", exc_info=(kind, error, trace))


def say_start(*lines: str) -> None:
    """Log lines with the service's addresses regardless of the log level, because launch scripts wait for them."""
    logger = logging.getLogger("intrasplat.start")
    logger.setLevel(logging.INFO)
    for line in lines:
        logger.info("%s", line)


def _is_no_refused_websocket(record: logging.LogRecord) -> bool:
    """Log filter: return False for uvicorn's error about a refused WebSocket, which the request log already records."""
    return record.getMessage() != "ASGI callable returned without completing handshake."


DURATIONS_S = (0.001, 0.0025, 0.005, 0.01, 0.0167, 0.0333, 0.05, 0.0667, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)


class AuditEntries(Collector):
    """Collector for the number of audit entries, including entries of the service itself."""

    def __init__(self, entries: Callable[[], int]) -> None:
        self._entries = entries

    def collect(self) -> Iterable[Metric]:
        """Export the entry count; see `Collector`."""
        return [CounterMetricFamily("intrasplat_audit_entries", "Entries of the audit log", value=self._entries())]


class Measures:
    """Metrics of one application, in its own registry."""

    def __init__(self, collectors: Sequence[Collector] = (), audit_entries: Callable[[], int] = lambda: 0) -> None:
        """Register all metrics.

        Args:
            collectors: further collectors to register.
            audit_entries: returns the number of entries in the audit log.
        """
        self.registry = CollectorRegistry(auto_describe=True)
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        for collector in (*collectors, AuditEntries(audit_entries)):
            self.registry.register(collector)
        self.requests = Counter(
            "intrasplat_http_requests", "Answered requests", ["method", "route", "status"], registry=self.registry
        )
        self.duration = Histogram(
            "intrasplat_http_request_duration_seconds", "From a request's head to the end of its answer",
            ["method", "route"], buckets=DURATIONS_S, registry=self.registry,
        )  # fmt: skip
        self.refused = Counter(
            "intrasplat_http_refused", "Requests refused by a limit or a guard", ["reason"], registry=self.registry
        )
        self.viewers = Gauge("intrasplat_viewers", "Open displays", ["transport"], registry=self.registry)
        self.viewers_dropped = Counter(
            "intrasplat_viewers_dropped", "Displays that were closed by the server", ["reason"], registry=self.registry
        )
        self.upload_bytes = Counter("intrasplat_upload_bytes", "Bytes of uploads taken in", registry=self.registry)
        Info("intrasplat_build", "Version of this server", registry=self.registry).info({"version": product_version()})


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
        """Return the metric families with the values of all added streams."""
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
            # The live model's version changes with every frame, and each value would create a new time series.
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
        self._events: collections.Counter[tuple[str, str, str]] = collections.Counter()

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
