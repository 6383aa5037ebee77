"""Supervision of a stream: its capture process and its engine process."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from services.bus.messages import ANSWER_S
from services.bus.runtime import Role, RuntimeFolder, StreamFolder
from services.supervisor.launching import Direct, Start
from services.supervisor.process import ManagedProcess, ProcessState, StreamEvent
from services.supervisor.specs import StreamSpec


@dataclass(frozen=True)
class StreamState:
    """Current state of a stream."""

    name: str
    capture: ProcessState
    engine: ProcessState


class StreamSupervisor:
    """Supervisor of one stream's processes, run in the creator's event loop. Loads no torch.

        stream = StreamSupervisor(spec, RuntimeFolder(path), on_event=audit)
        await stream.start()      # adopts running processes
        stream.state()
        await stream.stop("…")    # or detach(): the processes continue for the next supervisor

    Raises:
        RuntimeFolderUnusable: if the runtime folder cannot be used.
    """

    def __init__(
        self,
        spec: StreamSpec,
        runtime: RuntimeFolder,
        *,
        start: Start | None = None,
        on_event: Callable[[StreamEvent], None] = lambda event: None,
    ) -> None:
        """Create a supervisor; `start` begins the supervision.

        Args:
            spec: the stream.
            runtime: runtime folder of the service.
            start: process starter. `ByLauncher` restarts engines quickly and is shared by the
                streams of a runtime folder.
            on_event: called for each state change of a process.
        """
        self.spec = spec
        self._runtime = runtime
        self.folder: StreamFolder = runtime.stream(spec.name)
        start = start or Direct()
        self._capture = ManagedProcess(spec, "capture", self.folder, start, on_event)
        self._engine = ManagedProcess(spec, "engine", self.folder, start, on_event)

    async def start(self) -> None:
        """Adopt running processes with the same settings, start the missing ones, and supervise
        them."""
        self.folder = self._runtime.stream(self.spec.name)
        self._capture.open()
        self._engine.open()

    async def stop(self, reason: str = "it was asked for") -> None:
        """End both processes and remove the stream's runtime folder."""
        await self._engine.close(stop=True, reason=reason)
        await self._capture.close(stop=True, reason=reason)
        if self.folder.path.exists():
            self.folder.remove()

    async def detach(self, reason: str = "the control plane ends") -> None:
        """Stop supervising; the processes continue."""
        await asyncio.gather(*(each.close(stop=False, reason=reason) for each in (self._engine, self._capture)))

    async def restart(self, role: Role, reason: str = "it was asked for") -> None:
        """Restart one process."""
        await self._process(role).restart(reason)

    def state(self) -> StreamState:
        """Return the current state."""
        return StreamState(self.spec.name, self._capture.state, self._engine.state)

    def measures(self, role: Role) -> Mapping[str, Any]:
        """Return the Prometheus measures of a process."""
        return self._process(role).measures

    def causes(self, role: Role) -> Mapping[str, int]:
        """Return the number of process ends by cause."""
        return self._process(role).causes

    async def command(
        self, role: Role, command: str, *, timeout_s: float = ANSWER_S, **arguments: Any
    ) -> dict[str, Any]:
        """Send a command to a process (docs/design/processes.md lists them).

        Raises:
            NoAnswer: if the process does not run or does not answer.
            CommandRefused: if the process refuses the command.
        """
        return await self._process(role).command(command, timeout_s, arguments)

    def _process(self, role: Role) -> ManagedProcess:
        return self._capture if role == "capture" else self._engine
