"""Service log and Prometheus metrics of the control plane.

The log is on standard error, one line per event, with the request id. Labels of metrics hold route templates, never names from requests.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from contextvars import ContextVar
from datetime import UTC, datetime
from types import TracebackType

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, Metric
from prometheus_client.core import CounterMetricFamily
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from services import product_version
from services.settings.sections import LogSettings, masked_address

REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
_FACTS = "facts"


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
        entry.update(getattr(record, _FACTS, {}))
        if record.exc_info:
            entry["exception"] = masked_address(self.formatException(record.exc_info))
        return json.dumps(entry, ensure_ascii=True, default=str)


class TextFormatter(logging.Formatter):
    """Log formatter for terminals. Masks passwords in addresses and escapes line breaks of messages."""

    def format(self, record: logging.LogRecord) -> str:
        time = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        line = f"{time} {record.levelname.lower():7} {masked_address(record.getMessage())}"
        line += "".join(f" {name}={value}" for name, value in getattr(record, _FACTS, {}).items())
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


def facts(**values: object) -> dict[str, dict[str, object]]:
    """Return extra fields for a log line: `log.info("…", extra=facts(route="/v1/models"))`."""
    return {_FACTS: values}


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
