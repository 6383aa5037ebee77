"""Disk space and audit log checks for /readyz and metrics."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from services.audit import AuditError, AuditLog
from services.control.parts import CheckResult
from services.settings import ServiceSettings

log = logging.getLogger(__name__)
SPARE_BYTES = 256 * 2**20
"""Free bytes that uploads leave for the audit log and the database. With less the service is
degraded."""


def folders_of(settings: ServiceSettings) -> dict[str, Path]:
    """Return the data folders of the service, by name."""
    data = settings.data_dir
    return {
        "data": data,
        "recordings": settings.uploaded_recordings.folder or data / "recordings",
        "replays": settings.jobs.folder or data / "replays",
    }


class Storage(Collector):
    """Disks under the service's folders, and the writability of the audit log."""

    def __init__(self, folders: Mapping[str, Path], audit: AuditLog) -> None:
        self._folders, self._audit = folders, audit

    def collect(self) -> Iterable[Metric]:
        """Export free space, disk size and audit writability; see `Collector`."""
        free = GaugeMetricFamily("intrasplat_disk_free_bytes", "Free space under a folder.", labels=["folder"])
        size = GaugeMetricFamily("intrasplat_disk_bytes", "Size of the disk under a folder.", labels=["folder"])
        for name, folder in self._folders.items():
            try:
                usage = shutil.disk_usage(_existing(folder))
            except OSError as error:
                log.warning("the free space of %s is not known: %s", folder, error)
                continue
            free.add_metric([name], usage.free)
            size.add_metric([name], usage.total)
        writable = GaugeMetricFamily(
            "intrasplat_audit_writable", "0 after an entry of the audit log could not be written."
        )
        writable.add_metric([], float(self._audit.failure is None))
        return [free, size, writable]

    async def disk(self) -> CheckResult:
        """Report free space per folder. Less than `SPARE_BYTES` makes the service degraded."""
        return await asyncio.to_thread(self._disk)

    async def audit(self) -> CheckResult:
        """Report the audit log's writability. After a failure, append a test entry to detect
        recovery."""
        if self._audit.failure is None:
            return CheckResult(True, "entries are written")
        try:
            await asyncio.to_thread(self._audit.append, "audit.writable", actor="system", subject="audit")
        except AuditError as error:
            return CheckResult(False, str(error))
        return CheckResult(True, "entries are written again")

    def _disk(self) -> CheckResult:
        said, ok = [], True
        for name, folder in self._folders.items():
            try:
                free = shutil.disk_usage(_existing(folder)).free
            except OSError as error:
                ok = False
                said.append(f"{name}: {error.strerror}")
                continue
            ok = ok and free >= SPARE_BYTES
            said.append(f"{name}: {free // 2**20} MiB free")
        return CheckResult(ok, "; ".join(said) + ("" if ok else "; free space on that disk"), needed=False)


def _existing(folder: Path) -> Path:
    """Return the folder, or its nearest existing ancestor."""
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    return folder
