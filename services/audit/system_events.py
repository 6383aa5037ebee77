"""Audit events not caused by a request: ended processes, version checks, automatic rollbacks."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from services.audit import AuditLog, AuditUnwritable
from services.audit.files import Detail, Outcome

log = logging.getLogger(__name__)
MOST_WAITING = 1000


@dataclass(frozen=True)
class SystemEvent:
    """Audit entry that waits to be written. The fields have the meaning of those in `Entry`."""

    event: str
    subject: str
    outcome: Outcome
    detail: Detail


class SystemEvents:
    """Queue of system events. `tell` runs in the event loop and never blocks on the disk."""

    def __init__(self) -> None:
        self._waiting: deque[SystemEvent] = deque()
        self._missed = 0
        self._come = asyncio.Event()

    def tell(self, event: str, subject: str, outcome: Outcome = "done", **detail: str | int | None) -> None:
        """Queue an event. If the queue is full, the event is dropped and counted.

        Args:
            event: event name, such as `certificate.reload`.
            subject: name of the affected resource.
            outcome: `done`, `refused` or `failed`.
            detail: values for the entry.
        """
        if len(self._waiting) >= MOST_WAITING:
            self._missed += 1
            return
        self._waiting.append(SystemEvent(event, subject, outcome, {**detail}))
        self._come.set()

    @asynccontextmanager
    async def written_to(self, audit: AuditLog) -> AsyncIterator[None]:
        """Write queued events to the audit log while the block runs; flush the rest at its end."""
        writing = asyncio.create_task(self._write(audit), name="audit of system events")
        try:
            yield
        finally:
            writing.cancel()
            await asyncio.gather(writing, return_exceptions=True)
            await self._write_waiting(audit)

    async def _write(self, audit: AuditLog) -> None:
        while True:
            await self._come.wait()
            self._come.clear()
            await asyncio.shield(self._write_waiting(audit))

    async def _write_waiting(self, audit: AuditLog) -> None:
        while self._waiting:
            await asyncio.to_thread(_append, audit, self._waiting.popleft())
        missed, self._missed = self._missed, 0
        if missed:
            await asyncio.to_thread(_append, audit, SystemEvent("audit.missed", "audit", "failed", {"events": missed}))


def _append(audit: AuditLog, said: SystemEvent) -> None:
    try:
        audit.append(said.event, actor="system", subject=said.subject, outcome=said.outcome, detail=said.detail)
    # The event is already past and cannot be refused. The failure is logged and counted in the metrics.
    except (AuditUnwritable, ValueError) as error:
        log.error("%s of %s is not in the audit log: %s", said.event, said.subject, error)
