"""Check that the file of every model, recording and result in the database exists, at start and
during operation."""

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

from services.audit.system_events import SystemEvents
from services.control.parts import CheckResult
from services.errors import StoreUnavailable
from services.missing_files import MissingFile, StoredFiles, count_by_kind, missing_files
from services.registry.database import Database

log = logging.getLogger(__name__)
FRESH_S = 60.0
"""Seconds for which a disk check is cached, because /readyz is polled every few seconds."""


class StoredFilesWatch(Collector):
    """Watch on missing files. /readyz needs no key and reports numbers only; names are in the log
    and the API states."""

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
        """Check once at start and report missing files to the log and the audit log."""
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
        """Return rows whose files are missing, cached for `FRESH_S`.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        with self._lock:
            if self._looked_s is None or self._clock() - self._looked_s > FRESH_S:
                with self._database.reading() as connection:
                    self._missing = missing_files(connection, self._files)
                self._looked_s = self._clock()
            return self._missing

    async def check(self) -> CheckResult:
        """Report missing files for /readyz; they make the service degraded."""
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
