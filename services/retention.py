"""Retention of recordings and ended replays, at start and every few minutes, and the guard of the clock that it depends on.

Nothing is deleted by age until the clock has been consistent for some time.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from services.audit.log import SystemEvents
from services.errors import CheckFailed, NotFound, StoreUnavailable
from services.jobs.results import Replays
from services.recordings.store import RecordingStore

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
        """Set the age and total size beyond which recordings are deleted.

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
        """Delete recordings that are too old, or the oldest if all take too much space.

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
        """Set the age and number beyond which replays are deleted."""
        self._replays, self._most, self._events = replays, keep_results, events
        self._trusts_ages = trusts_ages
        self._max_age_s = None if keep_days is None else keep_days * DAY_S

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Delete replays beyond the age and number limits periodically while the block runs."""
        task = asyncio.create_task(again_and_again(self.enforce), name="retention of replays")
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def enforce(self) -> None:
        """Delete replays that are too old or too many.

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
    """Call `enforce` periodically until cancelled. A failure of the database is logged, and the next call tries again."""
    while True:
        try:
            await enforce()
        except StoreUnavailable as error:
            log.error("%s", error)
        await asyncio.sleep(AGAIN_S)


FILE = "clock.json"
JUMP_S = 86_400.0
"""Step of the clock, or pause between two runs of the service, in seconds, beyond which ages are not trusted."""
CONFIRM_S = 86_400.0
"""Seconds for which the service must run without another clock step before ages are trusted again."""
WRITE_S = 600.0


class ClockGuard:
    """Detector of clock jumps during and between runs of the service. Thread-safe.

    `clock.json` in the data folder stores the time. While the clock is not trusted, the file keeps
    the last trusted time, so a restart does not confirm a wrong clock. Deleting the file and
    starting the service confirms the clock at once.
    """

    def __init__(
        self,
        folder: Path,
        *,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._path, self._wall, self._monotonic = folder / FILE, wall, monotonic
        self._lock = threading.Lock()
        self._checked = wall(), monotonic()
        self._written_s: float | None = None
        self._since_s: float | None = None
        """Monotonic time at which a jump of the clock was detected, in seconds; None while the clock is trusted."""
        seen = self._read()
        if seen is not None and self._checked[0] - seen > JUMP_S:
            self._doubt(self._checked[0] - seen, "since the service last ran")

    @property
    def doubt(self) -> str | None:
        """Check the clock. Return the reason while it is not trusted, otherwise None."""
        with self._lock:
            self._check()
            if self._since_s is None:
                return None
            left_h = max(0.0, CONFIRM_S - (self._monotonic() - self._since_s)) / 3600
            return (
                f"the clock has jumped or the service stood still for long: nothing is removed by age for {left_h:.1f} h;"
                f" set the clock right, or remove {FILE} and start the service to confirm it"
            )

    def trusts_ages(self) -> bool:
        """Return True if data may be deleted by age."""
        return self.doubt is None

    def _check(self) -> None:
        wall_s, mono_s = self._wall(), self._monotonic()
        stepped_s = (wall_s - self._checked[0]) - (mono_s - self._checked[1])
        self._checked = wall_s, mono_s
        if abs(stepped_s) > JUMP_S:
            self._doubt(stepped_s, "while the service runs")
        elif self._since_s is not None and mono_s - self._since_s >= CONFIRM_S:
            log.warning("the clock has been consistent for %.0f h: ages are believed again", CONFIRM_S / 3600)
            self._since_s = None
        if self._since_s is None and (self._written_s is None or mono_s - self._written_s >= WRITE_S):
            self._write(wall_s)
            self._written_s = mono_s

    def _doubt(self, step_s: float, when: str) -> None:
        log.error("the clock went on by %.1f days %s: nothing is removed by age for now", step_s / 86_400, when)
        self._since_s = self._monotonic()

    def _read(self) -> float | None:
        """Return the stored time in seconds; None if the file does not exist. A damaged file gives a time that lets the
        clock count as jumped."""
        try:
            return float(json.loads(self._path.read_bytes())["seen_s"])
        except FileNotFoundError:
            pass
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            log.error("%s cannot be read: %s; ages are not believed for now", self._path, error)
            return -JUMP_S
        return None

    def _write(self, wall_s: float) -> None:
        new = self._path.with_suffix(".new")
        try:
            descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "w") as file:
                json.dump({"seen_s": wall_s}, file)
            os.replace(new, self._path)
        except OSError as error:
            log.warning("the time cannot be kept in %s: %s", self._path, error)
