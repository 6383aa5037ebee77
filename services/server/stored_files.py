"""Looks whether every model, recording and result that the database names is on the disk: at start, and again while the service runs."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager

from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from services.control.parts import CheckResult
from services.control.system_events import SystemEvents
from services.missing_files import MissingFile, StoredFiles, count_by_kind, missing_files
from services.registry.database import Database
from services.registry.errors import StoreUnavailable

log = logging.getLogger(__name__)
FRESH_S = 60.0
"""Time for which an answer of the disk is kept: /readyz is asked every few seconds."""


class StoredFilesWatch(Collector):
    """Missing files of one service. /readyz is asked without a key, so that it gets numbers; names are in the log and in the API's states."""

    def __init__(
        self,
        database: Database,
        files: StoredFiles,
        events: SystemEvents,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._database, self._files, self._events, self._clock = database, files, events, clock
        self._lock = threading.Lock()
        self._looked_s: float | None = None
        self._missing: list[MissingFile] = []

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Look once at the start, and have what is missing in the log and in the audit log."""
        try:
            missing = await asyncio.to_thread(self.missing)
        except StoreUnavailable as error:
            log.error("%s", error)
            missing = []
        for each in missing:
            log.error("the file of the %s is not on the disk: %s; restore it from a backup", each, each.path)
        if missing:
            self._events.tell("files.missing", "service", "failed", **count_by_kind(missing))
        yield

    def missing(self) -> list[MissingFile]:
        """Rows without files, as they are or were a moment ago. Raises StoreUnavailable."""
        with self._lock:
            if self._looked_s is None or self._clock() - self._looked_s > FRESH_S:
                with self._database.reading() as connection:
                    self._missing = missing_files(connection, self._files)
                self._looked_s = self._clock()
            return self._missing

    async def check(self) -> CheckResult:
        """For /readyz: missing files make the service degraded."""
        try:
            missing = await asyncio.to_thread(self.missing)
        except StoreUnavailable as error:
            return CheckResult(False, str(error))
        if not missing:
            return CheckResult(True, "every file is there", needed=False)
        said = ", ".join(f"{count} of {kind}s" for kind, count in count_by_kind(missing).items() if count)
        return CheckResult(False, f"files are missing: {said}; the log names them; restore a backup", needed=False)

    def collect(self) -> Iterable[Metric]:
        """See `Collector`."""
        family = GaugeMetricFamily(
            "intrasplat_files_missing", "Rows of the database without their file.", labels=["kind"]
        )
        try:
            for kind, count in count_by_kind(self.missing()).items():
                family.add_metric([kind], count)
        except StoreUnavailable as error:
            log.warning("%s", error)
        return [family]
