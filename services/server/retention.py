"""Retention of recordings and ended replays. Limits are enforced at start and every few minutes,
and each deletion is in the audit log."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

from services.audit.system_events import SystemEvents
from services.errors import CheckFailed, NotFound, StoreUnavailable
from services.recordings.store import RecordingStore
from services.server.replays import Replays

log = logging.getLogger(__name__)
AGAIN_S = 300.0
DAY_S = 86400.0


class RecordingRetention:
    """Retention task for the recording store."""

    def __init__(
        self,
        store: RecordingStore,
        keep_days: float | None,
        keep_bytes: int | None,
        events: SystemEvents,
        trusts_ages: Callable[[], bool] = lambda: True,
    ) -> None:
        """Set the limits.

        Args:
            store: recordings.
            keep_days: age limit, or None.
            keep_bytes: size limit, or None.
            events: receives events for the audit log.
            trusts_ages: returns True if data may be deleted by age now (`ClockGuard`).
        """
        self._store, self._keep_bytes, self._events = store, keep_bytes, events
        self._trusts_ages = trusts_ages
        self._max_age_s = None if keep_days is None else keep_days * DAY_S

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Recover the store, check pending recordings, and enforce the limits while the block runs."""
        waiting = await asyncio.to_thread(self._store.recover)
        tasks = [
            asyncio.create_task(self._check(waiting), name="checks of waiting recordings"),
            asyncio.create_task(again_and_again(self.enforce), name="retention of recordings"),
        ]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.to_thread(self._store.close)

    async def enforce(self) -> None:
        """Delete recordings beyond the limits.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        if self._max_age_s is None and self._keep_bytes is None:
            return
        max_age_s = self._max_age_s if self._trusts_ages() else None
        for each in await asyncio.to_thread(self._store.expire, max_age_s, self._keep_bytes):
            log.info("a recording was removed: %s", each.why)
            self._events.tell("recording.expire", each.name, why=each.why)

    async def _check(self, waiting: list[str]) -> None:
        for name in waiting:
            try:
                await asyncio.to_thread(self._store.check, name)
            except (NotFound, CheckFailed, StoreUnavailable) as error:
                log.error("a recording was not checked: %s", error)


class ReplayRetention:
    """Retention task for ended replays and their results."""

    def __init__(
        self,
        replays: Replays,
        keep_days: float | None,
        keep_results: int | None,
        events: SystemEvents,
        trusts_ages: Callable[[], bool] = lambda: True,
    ) -> None:
        """Set the limits; see `RecordingRetention`."""
        self._replays, self._most, self._events = replays, keep_results, events
        self._trusts_ages = trusts_ages
        self._max_age_s = None if keep_days is None else keep_days * DAY_S

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Enforce the limits while the block runs."""
        task = asyncio.create_task(again_and_again(self.enforce), name="retention of replays")
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def enforce(self) -> None:
        """Delete replays beyond the limits.

        Raises:
            StoreUnavailable: if the database does not answer.
        """
        if self._max_age_s is None and self._most is None:
            return
        max_age_s = self._max_age_s if self._trusts_ages() else None
        for each in await asyncio.to_thread(self._replays.expire, max_age_s, self._most):
            log.info("the replay %s was removed: %s", each.name, each.why)
            self._events.tell("replay.expire", each.name, why=each.why)


async def again_and_again(enforce: Callable[[], Awaitable[None]]) -> None:
    """Run `enforce` periodically until cancelled. Database failures are logged and retried."""
    while True:
        try:
            await enforce()
        except StoreUnavailable as error:
            log.error("%s", error)
        await asyncio.sleep(AGAIN_S)
