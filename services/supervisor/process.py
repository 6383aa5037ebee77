"""Supervision of one process of a stream: start or adoption, heartbeats, hang detection, and restarts with delays."""

from __future__ import annotations

import asyncio
import logging
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import zmq
import zmq.asyncio

from services.bus.messages import ANSWER_S, ask_async, parsed_json, subscribe
from services.bus.runtime import ProcessIdentity, Role, StreamFolder
from services.errors import BadMessage, BusError, NoAnswer
from services.supervisor.launcher import Start, cause_of, is_of_no_use, last_words
from services.supervisor.worker import ProcessSpec

FIRST_S = 0.25
MOST_WORKED_S = 1.0
MOST_S = 10.0
SETTLED_S = 2.0


class Restarts:
    """Restart back-off of one process. The first restart is immediate. Later delays double up to a cap. Restarts never
    stop, because a missing camera or GPU may return.

    The cap is low for a process that reached a good state, because viewers wait for its pictures. The cap is higher for
    a process that never did, because its restarts only take resources from other processes.
    """

    def __init__(
        self,
        first_s: float = FIRST_S,
        most_s: float = MOST_S,
        settled_s: float = SETTLED_S,
        most_worked_s: float = MOST_WORKED_S,
    ) -> None:
        """Set the delays between restarts, all in seconds.

        Args:
            first_s: delay before the second restart in a row; doubles with each further restart.
            most_s: cap for processes that never worked.
            settled_s: time in a good state after which the next end counts as the first in a row.
            most_worked_s: cap for processes that worked.
        """
        self._first_s, self._most_s, self._settled_s = first_s, most_s, settled_s
        self._most_worked_s = most_worked_s
        self.in_a_row = 0
        self.never_well = 0
        """Number of process ends since one that had reached a good state (`WELL`)."""
        self.total = 0

    def ended(self, well_s: float) -> float:
        """Count the end of the process.

        Args:
            well_s: seconds for which the process was in a good state.

        Returns:
            Seconds to wait before the restart.
        """
        self.total += 1
        self.in_a_row = 1 if well_s >= self._settled_s else self.in_a_row + 1
        self.never_well = 0 if well_s > 0 else self.never_well + 1
        if self.in_a_row == 1:
            return 0.0
        most_s = self._most_worked_s if well_s > 0 else self._most_s
        return float(min(most_s, self._first_s * 2 ** min(self.in_a_row - 2, 30)))


log = logging.getLogger(__name__)
POLL_S = 0.25
PING_S = 1.0
PAUSED_S = 1.0
"""Delay of a periodic check, in seconds, above which it is assumed that the supervisor itself was suspended."""
MOST_LOG_BYTES = 1 << 20
FRESH_AFTER = 3
"""Consecutive failed starts after which a new interpreter is used, because the launcher's forked
state may be the cause. A process that sent a good heartbeat started correctly."""
WELL = ("live", "running")
RATE_S = 3.0
"""Window of the rate measurement, in seconds."""
COUNTED: dict[Role, str] = {"capture": "frames", "engine": "pictures"}
"""Counter in the heartbeats whose rate is measured, by role of the process."""
SOURCE_GONE = ("opening", "stalled", "reconnecting", "lost", "ended")
"""States of a capture process in which its source delivers no frames."""
LOST_AFTER_S = 2.0
"""Seconds without frames after which loss of the source is reported. Shorter gaps appear in the metrics only."""
Kind = Literal["started", "adopted", "replaced", "ended", "stopped", "lost", "recovered"]


@dataclass(frozen=True)
class StreamEvent:
    """State change of a stream process, reported to the audit log and the metrics."""

    stream: str
    role: Role
    kind: Kind
    reason: str
    pid: int | None = None


@dataclass(frozen=True)
class ProcessState:
    """State of a stream process, from its newest heartbeat and the supervisor's own checks."""

    state: str
    """State from the heartbeat (`starting`, `live`, `running`, ...), or `down`, `failed`, `stopped`."""
    reason: str
    pid: int | None
    restarts: int
    figures: Mapping[str, Any]
    heard_s: float | None
    """Seconds since the last heartbeat; None if the process does not run or has not sent one."""
    rate_hz: float | None = None
    """Captured frames or new pictures per second over the last `RATE_S` seconds; None until 0.5 s are measured."""
    lost: bool = False
    """True if the source of a capture process gave no frames for `LOST_AFTER_S`."""


class Rate:
    """Estimator of a counter's rate over the last `RATE_S` seconds, from irregular samples."""

    def __init__(self, over_s: float = RATE_S) -> None:
        self._over_s = over_s
        self._samples: deque[tuple[float, int]] = deque()

    def tell(self, count: int, now_s: float) -> None:
        """Add a sample. A smaller count than before is from a new process and restarts the measurement."""
        if self._samples and count < self._samples[-1][1]:
            self._samples.clear()
        self._samples.append((now_s, count))
        while len(self._samples) > 2 and now_s - self._samples[1][0] >= self._over_s:
            self._samples.popleft()

    def clear(self) -> None:
        """Discard all samples of the counter."""
        self._samples.clear()

    @property
    def hz(self) -> float | None:
        """Return counts per second, or None until the samples span half a second."""
        if not self._samples:
            return None
        (first_s, first), (last_s, last) = self._samples[0], self._samples[-1]
        return round((last - first) / (last_s - first_s), 2) if last_s - first_s >= 0.5 else None


class ManagedProcess:
    """Supervisor of one stream process; keeps it running until closed."""

    def __init__(
        self,
        spec: ProcessSpec,
        folder: StreamFolder,
        start: Start,
        on_event: Callable[[StreamEvent], None],
    ) -> None:
        self._spec, self._role, self._folder = spec, spec.role, folder
        self._start, self._on_event = start, on_event
        self._restarts = Restarts()
        self._identity: ProcessIdentity | None = None
        self._causes: Counter[str] = Counter()
        self._down: tuple[str, str] = "stopped", "it was not started"
        self._heartbeat: dict[str, Any] | None = None
        self._heard_s = self._well_s = 0.0
        self._shown: tuple[int, float] = 0, 0.0
        """Number of pictures that the process has published, and the time at which this number last changed."""
        self._rate = Rate()
        self._gone_s: float | None = None
        """Time of the first heartbeat without frames from the source; None while frames arrive."""
        self._lost = False
        """True from the report that the source is lost until the report that it has recovered."""
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def state(self) -> ProcessState:
        """Return the current state."""
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
        """Return the number of process ends by cause."""
        return dict(self._causes)

    @property
    def measures(self) -> Mapping[str, Any]:
        """Return the Prometheus measures of the newest heartbeat; empty without any."""
        heartbeat = self._heartbeat
        measures = None if heartbeat is None else heartbeat.get("measures")
        return measures if isinstance(measures, dict) else {}

    def open(self) -> None:
        """Adopt the running process or start one, and keep it running."""
        if not self._tasks:
            self._gone_s, self._lost = None, False
            each = (self._keep, self._listen, self._ping)
            self._tasks = [asyncio.create_task(task(), name=f"{self._spec.stream} {self._role}") for task in each]

    async def close(self, reason: str) -> None:
        """End the process, by SIGKILL if it does not finish in time, and its supervision.

        Args:
            reason: text for the log and the state.
        """
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        identity, self._identity = self._identity, None
        self._down = "stopped", reason
        record = self._folder.record(self._role)
        for each in {identity, None if record is None else record.identity} - {None}:
            assert each is not None
            await self._end(each)
        self._folder.clean(self._role)
        self._say("stopped", reason, identity)

    async def command(self, command: str, *, timeout_s: float = ANSWER_S, **arguments: Any) -> dict[str, Any]:
        """Send a command to the process (docs/design/processes.md lists them).

        Raises:
            NoAnswer: if the process does not run or does not answer.
            CommandRefused: if the process refuses the command.
        """
        if self._identity is None:
            raise NoAnswer(f"the {self._role} process of {self._spec.stream} does not run: {self._down[1]}")
        return await ask_async(self._folder.commands(self._role), command, timeout_s=timeout_s, **arguments)

    async def _keep(self) -> None:
        while True:
            try:
                identity = await self._running()
            except OSError as error:
                identity, self._down = None, ("down", f"it cannot be started: {error}")
            if identity is not None:
                how = await self._watched(identity)
            elif self._down[0] == "down":  # it could not be started
                how = self._down[1]
            else:
                how = "it ended at once"
            self._identity, self._heartbeat = None, None
            try:
                if self._folder.record(self._role) is not None:
                    continue  # another process already serves this role; adopt it
                self._folder.clean(self._role)
            except OSError as error:
                log.warning("%s %s: %s", self._spec.stream, self._role, error)
            well_s = time.monotonic() - self._well_s if self._well_s else 0.0
            wait_s = self._restarts.ended(well_s)
            self._causes[cause_of(how)] += 1
            if is_of_no_use(how):
                how, wait_s = last_words(self._folder.log(self._role)) or how, MOST_S
            self._down = ("failed" if wait_s >= MOST_S else "down"), how
            self._say("ended", how, identity)
            await asyncio.sleep(wait_s)

    async def _running(self) -> ProcessIdentity | None:
        """Return the process for this role: adopt the running process if its settings match, otherwise start a new
        process. None if the start failed."""
        record = self._folder.record(self._role)
        digest = self._spec.digest
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
        self._folder.path.mkdir(mode=0o700, exist_ok=True)  # it may have been deleted
        output = self._folder.log(self._role)
        if output.exists() and output.stat().st_size > MOST_LOG_BYTES:
            output.unlink()
        arguments = ["--spec", str(self._spec.write(self._folder))]
        if self._role == "engine" and self._restarts.total:
            arguments.append("--again")
        self._down = "starting", "it is being started"
        try:
            module, fresh = f"services.supervisor.{self._role}", self._restarts.never_well >= FRESH_AFTER
            starting = asyncio.create_task(
                self._start.start(module, arguments, output, self._environment(), fresh=fresh)
            )
            try:
                pid = await asyncio.shield(starting)
            except asyncio.CancelledError:
                # The process may exist already. `close` ends the identity that is known here.
                await asyncio.wait({starting})
                if starting.exception() is None:
                    self._identity = ProcessIdentity.of(starting.result())
                raise
        except OSError as error:
            self._down = "down", f"it cannot be started: {error}"
            return None
        self._identity = ProcessIdentity.of(pid)
        if self._identity is not None:
            self._say("started", "again" if self._restarts.total else "for the first time", self._identity)
        return self._identity

    def _environment(self) -> dict[str, str]:
        engine = self._spec.engine
        return {} if engine is None or engine.gpu is None else {"CUDA_VISIBLE_DEVICES": str(engine.gpu)}

    async def _watched(self, identity: ProcessIdentity) -> str:
        """Wait for the end of the process; kill it if it hangs.

        Returns:
            Description of how it ended.
        """
        ended = asyncio.create_task(identity.ended())
        killed: str | None = None
        looked_s = time.monotonic()
        try:
            while not ended.done():
                await asyncio.wait({ended}, timeout=POLL_S)
                now_s = time.monotonic()
                if now_s - looked_s > POLL_S + PAUSED_S:
                    self._heard_s = now_s  # while suspended, the supervisor could not receive heartbeats
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
        """Return the reason why the process counts as hung (missing heartbeats or pictures); None if it does not."""
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
        """Receive heartbeats, and evaluate those whose process id is that of the supervised process."""
        socket = subscribe(zmq.asyncio.Context.instance().socket(zmq.SUB), self._folder.status(self._role), waiting=16)
        try:
            while True:
                try:
                    said = parsed_json(await socket.recv())
                except BadMessage as error:
                    log.warning("%s %s: %s", self._spec.stream, self._role, error)
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
            self._note_source_state(str(said.get("state")), str(said.get("reason")), now_s)

    def _note_source_state(self, state: str, reason: str, now_s: float) -> None:
        """Report a loss of the source once it lasts `LOST_AFTER_S`, and then its recovery."""
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
        """Send the stream process this supervisor's identity periodically, so that an adopted process does not end
        itself as an orphan."""
        own = asdict(ProcessIdentity.own())
        while True:
            await asyncio.sleep(PING_S)
            if self._identity is not None and self._heartbeat is not None:
                try:
                    await ask_async(self._folder.commands(self._role), "ping", supervisor=own)
                except BusError as error:
                    # An unanswered ping has no consequence: hangs are detected by missing heartbeats.
                    log.info("%s %s: %s", self._spec.stream, self._role, error)

    async def _end(self, identity: ProcessIdentity) -> None:
        """Ask a process to finish; kill it after `drain_s`."""
        identity.signal(signal.SIGTERM)
        identity.signal(signal.SIGCONT)
        if not await identity.ended(self._spec.limits.drain_s):
            identity.signal(signal.SIGKILL)
            await identity.ended()
        await self._start.how_ended(identity.pid)

    def _say(self, kind: Kind, reason: str, identity: ProcessIdentity | None) -> None:
        pid = None if identity is None else identity.pid
        level = logging.WARNING if kind == "lost" else logging.INFO
        log.log(level, "%s %s %s (%s): %s", self._spec.stream, self._role, kind, pid, reason)
        self._on_event(StreamEvent(self._spec.stream, self._role, kind, reason, pid))
