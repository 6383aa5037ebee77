"""Prometheus metrics of the control plane. Labels hold route templates, never names from requests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, Metric
from prometheus_client.core import CounterMetricFamily
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from services.version import product_version

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
