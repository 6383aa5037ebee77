"""One process of a stream, kept running: started or adopted, listened to, ended when it hangs, started again when it has ended."""

from __future__ import annotations

import asyncio
import logging
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import zmq
import zmq.asyncio

from services.bus.commands import ask_async
from services.bus.errors import BadMessage, BusError, NoAnswer
from services.bus.messages import parsed_json
from services.bus.pictures import subscribe
from services.bus.process_identity import ProcessIdentity
from services.bus.runtime import Role, StreamFolder
from services.supervisor.launching import Start
from services.supervisor.process_end import cause_of, is_of_no_use, last_words
from services.supervisor.restarts import MOST_S, Restarts
from services.supervisor.specs import StreamSpec

log = logging.getLogger(__name__)
LOOK_S = 0.25
PING_S = 1.0
PAUSED_S = 1.0
"""When so much more time has passed between two looks, it is the supervisor that stood still."""
MOST_LOG_BYTES = 1 << 20
FRESH_AFTER = 3
"""After so many ends in a row of a process that had not begun to work it is started by a new interpreter: what it was forked from may be what is
wrong. One that has worked was forked well."""
WELL = ("live", "running")
RATE_S = 3.0
"""Time over which a process' rate is taken."""
COUNTED: dict[Role, str] = {"capture": "frames", "engine": "pictures"}
"""Figure of the heartbeats whose rate is told."""

SOURCE_GONE = ("opening", "stalled", "reconnecting", "lost", "ended")
"""States of a capture process that has no frames to give."""
LOST_AFTER_S = 2.0
"""Time without frames after which the source counts as lost: a short break is in the metrics alone."""

Kind = Literal["started", "adopted", "replaced", "ended", "stopped", "left", "lost", "recovered"]


@dataclass(frozen=True)
class StreamEvent:
    """Something that happened to a process of a stream; audit and metrics are told each."""

    stream: str
    role: Role
    kind: Kind
    reason: str
    pid: int | None = None


@dataclass(frozen=True)
class ProcessState:
    """What is known of a process now."""

    state: str
    """What its heartbeat says (`starting`, `live`, `running`, ...), or `down`, `failed`, `stopped`."""
    reason: str
    pid: int | None
    restarts: int
    figures: Mapping[str, Any]
    heard_s: float | None
    """Seconds since its last heartbeat."""
    rate_hz: float | None = None
    """Frames captured, or new pictures shown, a second over the last `RATE_S`."""
    lost: bool = False
    """A capture process whose source has given no frames for `LOST_AFTER_S`."""


class Rate:
    """Rate of a count that is told now and then."""

    def __init__(self, over_s: float = RATE_S) -> None:
        self._over_s = over_s
        self._told: deque[tuple[float, int]] = deque()

    def tell(self, count: int, now_s: float) -> None:
        """Note the count at a moment. One that is smaller than before is that of a new process: the rate begins anew."""
        if self._told and count < self._told[-1][1]:
            self._told.clear()
        self._told.append((now_s, count))
        while len(self._told) > 2 and now_s - self._told[1][0] >= self._over_s:
            self._told.popleft()

    def clear(self) -> None:
        """Forget what was told."""
        self._told.clear()

    @property
    def hz(self) -> float | None:
        """Counts a second; None until there are two moments at least half a second apart."""
        if not self._told:
            return None
        (first_s, first), (last_s, last) = self._told[0], self._told[-1]
        return round((last - first) / (last_s - first_s), 2) if last_s - first_s >= 0.5 else None


class ManagedProcess:
    """Keeps one process of a stream running until it is closed."""

    def __init__(
        self,
        spec: StreamSpec,
        role: Role,
        folder: StreamFolder,
        start: Start,
        on_event: Callable[[StreamEvent], None],
    ) -> None:
        self._spec, self._role, self._folder = spec, role, folder
        self._start, self._on_event = start, on_event
        self._restarts = Restarts()
        self._identity: ProcessIdentity | None = None
        self._causes: Counter[str] = Counter()
        self._down: tuple[str, str] = "stopped", "it was not started"
        self._heartbeat: dict[str, Any] | None = None
        self._heard_s = self._well_s = 0.0
        self._shown: tuple[int, float] = 0, 0.0
        """How much was published, and since when that is so."""
        self._rate = Rate()
        self._gone_s: float | None = None
        """Since when the source has given no frames."""
        self._lost = False
        """The loss of the source was told, and its return not yet."""
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def state(self) -> ProcessState:
        """What is known now."""
        identity, heartbeat = self._identity, self._heartbeat
        restarts = self._restarts.total
        if identity is None:
            return ProcessState(*self._down, None, restarts, {}, None)
        if heartbeat is None:
            return ProcessState("starting", "it has not said anything yet", identity.pid, restarts, {}, None)
        silent_s = time.monotonic() - self._heard_s
        said = str(heartbeat.get("state")), str(heartbeat.get("reason"))
        figures = heartbeat.get("figures")
        return ProcessState(
            *said,
            identity.pid,
            restarts,
            figures if isinstance(figures, dict) else {},
            round(silent_s, 3),
            self._rate.hz,
            self._lost,
        )

    @property
    def causes(self) -> Mapping[str, int]:
        """How often the process has ended, by cause."""
        return dict(self._causes)

    @property
    def measures(self) -> Mapping[str, Any]:
        """What its newest heartbeat tells for Prometheus."""
        heartbeat = self._heartbeat
        told = None if heartbeat is None else heartbeat.get("measures")
        return told if isinstance(told, dict) else {}

    def open(self) -> None:
        """Take over the process that runs, or start one, and keep it running."""
        if not self._tasks:
            self._gone_s, self._lost = None, False
            each = (self._keep, self._listen, self._ping)
            self._tasks = [asyncio.create_task(task(), name=f"{self._spec.name} {self._role}") for task in each]

    async def close(self, *, stop: bool, reason: str) -> None:
        """Look after it no more; with `stop` it is asked to finish, and killed when it does not."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        identity, self._identity = self._identity, None
        self._down = "stopped", reason
        if not stop:
            self._say("left", reason, identity)
            return
        record = self._folder.record(self._role)
        for each in {identity, None if record is None else record.identity} - {None}:
            assert each is not None
            await self._end(each)
        self._folder.clean(self._role)
        self._say("stopped", reason, identity)

    async def restart(self, reason: str) -> None:
        """Have the process finish; another one follows."""
        if self._identity is not None:
            log.info("%s %s is started again: %s", self._spec.name, self._role, reason)
            await self._end(self._identity)

    async def command(self, command: str, timeout_s: float, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Send a command. Raises NoAnswer and CommandRefused."""
        if self._identity is None:
            raise NoAnswer(f"the {self._role} process of {self._spec.name} does not run: {self._down[1]}")
        return await ask_async(self._folder.commands(self._role), command, timeout_s=timeout_s, **arguments)

    async def _keep(self) -> None:
        while True:
            identity = await self._running()
            if identity is not None:
                how = await self._watched(identity)
            else:
                how = "it ended at once"
            self._identity, self._heartbeat = None, None
            if self._folder.record(self._role) is not None:
                continue  # another one was there before, and serves the stream
            self._folder.clean(self._role)
            well_s = time.monotonic() - self._well_s if self._well_s else 0.0
            wait_s = self._restarts.ended(well_s)
            self._causes[cause_of(how)] += 1
            if is_of_no_use(how):
                how, wait_s = last_words(self._folder.log(self._role)) or how, MOST_S
            self._down = ("failed" if wait_s >= MOST_S else "down"), how
            self._say("ended", how, identity)
            await asyncio.sleep(wait_s)

    async def _running(self) -> ProcessIdentity | None:
        """The process that serves the part: the one that runs already, where it was asked for the same, or a new one."""
        record = self._folder.record(self._role)
        digest = self._spec.digest(self._role)
        if record is not None and record.spec_digest != digest:
            self._say("replaced", "it was started for other settings", record.identity)
            await self._end(record.identity)
            record = None
        self._heartbeat, self._well_s, self._shown = None, 0.0, (0, 0.0)
        self._rate.clear()
        self._heard_s = time.monotonic()
        if record is not None:
            self._identity = record.identity
            self._say("adopted", "it ran already", record.identity)
            return record.identity
        return await self._started()

    async def _started(self) -> ProcessIdentity | None:
        output = self._folder.log(self._role)
        if output.exists() and output.stat().st_size > MOST_LOG_BYTES:
            output.unlink()
        arguments = ["--spec", str(self._spec.write(self._role, self._folder))]
        if self._role == "engine" and self._restarts.total:
            arguments.append("--again")
        self._down = "starting", "it is being started"
        try:
            module, fresh = f"services.supervisor.{self._role}", self._restarts.never_well >= FRESH_AFTER
            pid = await self._start.start(module, arguments, output, self._environment(), fresh=fresh)
        except OSError as error:
            self._down = "down", f"it cannot be started: {error}"
            return None
        self._identity = ProcessIdentity.of(pid)
        if self._identity is not None:
            self._say("started", "again" if self._restarts.total else "for the first time", self._identity)
        return self._identity

    def _environment(self) -> dict[str, str]:
        gpu = self._spec.engine.gpu
        return {"CUDA_VISIBLE_DEVICES": str(gpu)} if self._role == "engine" and gpu is not None else {}

    async def _watched(self, identity: ProcessIdentity) -> str:
        """Wait for the end of the process, and bring it about where it hangs; how it ended."""
        ended = asyncio.create_task(identity.ended())
        killed: str | None = None
        looked_s = time.monotonic()
        try:
            while not ended.done():
                await asyncio.wait({ended}, timeout=LOOK_S)
                now_s = time.monotonic()
                if now_s - looked_s > LOOK_S + PAUSED_S:
                    self._heard_s = now_s  # nobody has listened meanwhile
                    self._shown = self._shown[0], now_s
                looked_s = now_s
                hangs = None if killed or ended.done() else self._hangs(now_s)
                if hangs is not None:
                    killed = f"{hangs}; it was killed"
                    identity.signal(signal.SIGKILL)
        finally:
            ended.cancel()
        how = await self._start.how_ended(identity.pid)
        return killed or how or self._last_reason() or "it ended"

    def _hangs(self, now_s: float) -> str | None:
        """Why the process is taken to hang; None where it is well."""
        limits = self._spec.limits
        silent_s = now_s - self._heard_s
        if self._heartbeat is None:
            return f"it has not begun within {limits.start_s:g} s" if silent_s > limits.start_s else None
        if silent_s > limits.heartbeat_s:
            return f"it has said nothing for {silent_s:.1f} s"
        published, since_s = self._shown
        if published and now_s - since_s > limits.hung_s:
            return f"it has published nothing for {now_s - since_s:.1f} s"
        return None

    def _last_reason(self) -> str | None:
        heartbeat = self._heartbeat
        ended = heartbeat is not None and heartbeat.get("state") in ("ended", "failed")
        return str(heartbeat.get("reason")) if heartbeat is not None and ended else None

    async def _listen(self) -> None:
        """Take the heartbeats of whichever process serves the part."""
        socket = subscribe(zmq.asyncio.Context.instance().socket(zmq.SUB), self._folder.status(self._role), waiting=16)
        try:
            while True:
                try:
                    said = parsed_json(await socket.recv())
                except BadMessage as error:
                    log.warning("%s %s: %s", self._spec.name, self._role, error)
                    continue
                if self._identity is not None and said.get("pid") == self._identity.pid:
                    self._take(said)
        finally:
            socket.close()

    def _take(self, said: dict[str, Any]) -> None:
        now_s = time.monotonic()
        self._heartbeat, self._heard_s = said, now_s
        figures = said.get("figures")
        published = figures.get("published", 0) if isinstance(figures, dict) else 0
        count = figures.get(COUNTED[self._role]) if isinstance(figures, dict) else None
        if isinstance(count, int):
            self._rate.tell(count, now_s)
        if not self._well_s and said.get("state") in WELL and (published or self._role == "capture"):
            self._well_s = now_s
        if published != self._shown[0]:
            self._shown = published, now_s
        if self._role == "capture":
            self._look_at_source(str(said.get("state")), str(said.get("reason")), now_s)

    def _look_at_source(self, state: str, reason: str, now_s: float) -> None:
        """Tell once when the source is lost, and once when it gives frames again."""
        if state == "live":
            self._gone_s = None
            if self._lost:
                self._lost = False
                self._say("recovered", reason, self._identity)
        elif state in SOURCE_GONE:
            if self._gone_s is None:
                self._gone_s = now_s
            if not self._lost and now_s - self._gone_s >= LOST_AFTER_S:
                self._lost = True
                self._say("lost", reason, self._identity)

    async def _ping(self) -> None:
        """Tell the process that somebody looks after it."""
        while True:
            await asyncio.sleep(PING_S)
            if self._identity is not None and self._heartbeat is not None:
                try:
                    await ask_async(self._folder.commands(self._role), "ping")
                except BusError as error:
                    log.info("%s %s: %s", self._spec.name, self._role, error)  # its heartbeats say whether it is well

    async def _end(self, identity: ProcessIdentity) -> None:
        """Have a process finish, or kill it when it does not within its time."""
        identity.signal(signal.SIGTERM)
        identity.signal(signal.SIGCONT)
        if not await identity.ended(self._spec.limits.drain_s):
            identity.signal(signal.SIGKILL)
            await identity.ended()
        await self._start.how_ended(identity.pid)

    def _say(self, kind: Kind, reason: str, identity: ProcessIdentity | None) -> None:
        pid = None if identity is None else identity.pid
        level = logging.WARNING if kind == "lost" else logging.INFO
        log.log(level, "%s %s %s (%s): %s", self._spec.name, self._role, kind, pid, reason)
        self._on_event(StreamEvent(self._spec.name, self._role, kind, reason, pid))
