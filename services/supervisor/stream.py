"""A stream: its capture process and its engine process, kept running."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from services.bus.commands import ANSWER_S
from services.bus.runtime import Role, RuntimeFolder, StreamFolder
from services.supervisor.launching import Direct, Start
from services.supervisor.process import ManagedProcess, ProcessState, StreamEvent
from services.supervisor.specs import StreamSpec


@dataclass(frozen=True)
class StreamState:
    """What is known of a stream now."""

    name: str
    capture: ProcessState
    engine: ProcessState


class StreamSupervisor:
    """Keeps the processes of one stream running, in the event loop of the process that makes it; loads no torch.

        stream = StreamSupervisor(spec, RuntimeFolder(path), on_event=audit)
        await stream.start()      # adopts what runs already
        stream.state()
        await stream.stop("…")    # or detach(): the processes go on, for the next supervisor to adopt

    Raises RuntimeFolderUnusable.
    """

    def __init__(
        self,
        spec: StreamSpec,
        runtime: RuntimeFolder,
        *,
        start: Start | None = None,
        on_event: Callable[[StreamEvent], None] = lambda event: None,
    ) -> None:
        """start: how processes are started, `ByLauncher` for a quick return of engines, shared by the streams of a runtime folder."""
        self.spec = spec
        self._runtime = runtime
        self.folder: StreamFolder = runtime.stream(spec.name)
        start = start or Direct()
        self._capture = ManagedProcess(spec, "capture", self.folder, start, on_event)
        self._engine = ManagedProcess(spec, "engine", self.folder, start, on_event)

    async def start(self) -> None:
        """Adopt the processes that run with the same settings, start those that do not, and look after them."""
        self.folder = self._runtime.stream(self.spec.name)
        self._capture.open()
        self._engine.open()

    async def stop(self, reason: str = "it was asked for") -> None:
        """Have both processes finish; nothing of the stream is left."""
        await self._engine.close(stop=True, reason=reason)
        await self._capture.close(stop=True, reason=reason)
        if self.folder.path.exists():
            self.folder.remove()

    async def detach(self, reason: str = "the control plane ends") -> None:
        """Look after the processes no more; they go on."""
        await asyncio.gather(*(each.close(stop=False, reason=reason) for each in (self._engine, self._capture)))

    async def restart(self, role: Role, reason: str = "it was asked for") -> None:
        """Have a process finish and start it again."""
        await self._process(role).restart(reason)

    def state(self) -> StreamState:
        """What is known now."""
        return StreamState(self.spec.name, self._capture.state, self._engine.state)

    def measures(self, role: Role) -> Mapping[str, Any]:
        """What a process tells for Prometheus."""
        return self._process(role).measures

    def causes(self, role: Role) -> Mapping[str, int]:
        """How often a process has ended, by cause."""
        return self._process(role).causes

    async def command(
        self, role: Role, command: str, *, timeout_s: float = ANSWER_S, **arguments: Any
    ) -> dict[str, Any]:
        """Send a command to a process (docs/design/processes.md lists them). Raises NoAnswer and CommandRefused."""
        return await self._process(role).command(command, timeout_s, arguments)

    def _process(self, role: Role) -> ManagedProcess:
        return self._capture if role == "capture" else self._engine
