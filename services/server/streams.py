"""Streams of a server, each run by a supervisor."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from gsplat_core.errors import InvalidSetting
from services.bus.runtime import Role, RuntimeFolder
from services.control.parts import NewStream
from services.control.problems import Conflicting, Missing, Unprocessable
from services.display.hub import KINDS, DisplayHub
from services.server.stream_specs import gpus, spec_of
from services.supervisor.launching import ByLauncher
from services.supervisor.process import ProcessState, StreamEvent
from services.supervisor.scratch import remove_dead
from services.supervisor.specs import StreamSpec, assigned
from services.supervisor.stream import StreamSupervisor

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StreamFacts:
    """Implementation of `services.control.parts.StreamState`."""

    name: str
    source: str
    show: str
    device: str
    options: Mapping[str, Any]
    state: str
    reason: str | None
    processes: Mapping[str, Mapping[str, Any]]
    viewers: Mapping[str, int] = field(default_factory=dict)


OUT_OF_BODY = "out of body"
"""Reason string of frames withheld by the engine's out-of-body gate."""


class Stream:
    """Configured stream, with its supervisor and display hub while it runs."""

    def __init__(self, wanted: NewStream, spec: StreamSpec) -> None:
        self.wanted, self.spec = wanted, spec
        self.supervisor: StreamSupervisor | None = None
        self.hub: DisplayHub | None = None
        self.changing = asyncio.Lock()
        """Serialises start, stop and changes of the stream."""

    def facts(self) -> StreamFacts:
        """Return configuration and current state."""
        wanted = self.wanted
        engine = self.spec.engine
        device = engine.device if engine.gpu is None else f"{engine.device}:{engine.gpu}"
        about = (wanted.name, wanted.source, wanted.show, device, wanted.options)
        if self.supervisor is None:
            return StreamFacts(*about, "stopped", None, {})
        now = self.supervisor.state()
        state, reason = overall(now.capture, now.engine)
        processes = {"capture": asdict(now.capture), "engine": asdict(now.engine)}
        viewers: dict[str, int] = {} if self.hub is None else {str(kind): self.hub.viewers(kind) for kind in KINDS}
        return StreamFacts(*about, state, reason, processes, viewers)


def overall(capture: ProcessState, engine: ProcessState) -> tuple[str, str | None]:
    """Derive the state of a stream and the reason from its processes."""
    for process in (capture, engine):
        if process.state == "failed":
            return "failed", process.reason
    if capture.lost or capture.state in ("stalled", "reconnecting", "lost", "ended"):
        return "source lost", capture.reason
    if capture.state != "live":
        return "starting", capture.reason
    if engine.state != "running":
        return "starting", f"the camera's picture is live; the engine is {engine.state}: {engine.reason}"
    shown = (engine.figures.get("picture") or {}).get("state")
    if shown in ("live", "stale", "frozen", "source lost"):
        return str(shown), None
    return "starting", _withheld(engine) or "the first picture is being made"


def _withheld(engine: ProcessState) -> str | None:
    """Explain why a running engine has shown no picture although frames arrived; None if no frame
    was withheld."""
    frames, withheld = engine.figures.get("frames"), engine.figures.get("withheld")
    if not frames or not isinstance(withheld, Mapping) or not withheld:
        return None
    counts = ", ".join(f"{reason}: {count}" for reason, count in sorted(withheld.items(), key=lambda each: -each[1]))
    hint = "; the stream's option out_of_body: off lets those out of body pass" if OUT_OF_BODY in withheld else ""
    return f"nothing is shown: of {frames} frames {sum(withheld.values())} were withheld ({counts}){hint}"


class SupervisedStreams:
    """Implementation of `services.control.parts.Streams`; `running` is entered with the server."""

    def __init__(self, runtime: RuntimeFolder, on_event: Callable[[StreamEvent], None], most: int = 16) -> None:
        """Create the manager without streams.

        Args:
            runtime: runtime folder of the service.
            on_event: receives process events.
            most: limit on the number of streams, including stopped ones (`limits.streams`).
        """
        self._runtime, self._on_event, self._most = runtime, on_event, most
        self._launcher = ByLauncher(runtime)
        self._streams: dict[str, Stream] = {}

    @asynccontextmanager
    async def running(self, at_start: Sequence[NewStream], started: Sequence[str]) -> AsyncIterator[None]:
        """Create the streams `at_start` and start those named in `started`. All streams are stopped
        at the end of the block."""
        await asyncio.to_thread(remove_dead)
        for stream in at_start:
            await self.create(stream)
        for name in started:
            await self.start(name)
        try:
            yield
        finally:
            await asyncio.gather(*(self._stop(stream, "the server ends") for stream in self._streams.values()))
            await self._launcher.close(stop=True)
            await asyncio.to_thread(remove_dead)

    def hub(self, name: str) -> DisplayHub | None:
        """Return the display hub of a stream, or None if it does not run."""
        stream = self._streams.get(name)
        return None if stream is None else stream.hub

    def measures(self, name: str, role: Role) -> Mapping[str, Any]:
        """Return the Prometheus measures of a process; empty if the stream does not run."""
        supervisor = self._streams[name].supervisor if name in self._streams else None
        return {} if supervisor is None else supervisor.measures(role)

    def causes(self, name: str, role: Role) -> Mapping[str, int]:
        """Return the number of process ends by cause since the stream was started."""
        supervisor = self._streams[name].supervisor if name in self._streams else None
        return {} if supervisor is None else supervisor.causes(role)

    def now(self) -> Sequence[StreamFacts]:
        """Return the state of every stream."""
        return [stream.facts() for stream in self._streams.values()]

    def running_streams(self) -> Sequence[Stream]:
        """Return the running streams."""
        return [stream for stream in self._streams.values() if stream.supervisor is not None]

    async def all(self) -> Sequence[StreamFacts]:
        """See `Streams`."""
        return self.now()

    async def get(self, name: str) -> StreamFacts:
        """See `Streams`.

        Raises:
            Missing: if the stream does not exist.
        """
        return self._stream(name).facts()

    async def create(self, stream: NewStream) -> StreamFacts:
        """See `Streams`.

        Raises:
            Conflicting: if the name is taken or the limit is reached.
            Unprocessable: if the configuration is not valid.
        """
        if stream.name in self._streams:
            raise Conflicting(f"there is a stream {stream.name}; delete it first, or choose another name")
        if len(self._streams) >= self._most:
            raise Conflicting(f"there are {self._most} streams, which is limits.streams; delete one, or raise it")
        made = self._streams[stream.name] = Stream(stream, self._spec(stream))
        return made.facts()

    async def start(self, name: str) -> StreamFacts:
        """See `Streams`.

        Raises:
            Missing: if the stream does not exist.
        """
        stream = self._stream(name)
        async with stream.changing:
            if stream.supervisor is None:
                self._launcher.open()  # opened with the first stream, because its preloaded modules take memory
                supervisor = StreamSupervisor(stream.spec, self._runtime, start=self._launcher, on_event=self._on_event)
                await supervisor.start()
                stream.supervisor, stream.hub = supervisor, DisplayHub(supervisor.folder)
        return stream.facts()

    async def stop(self, name: str) -> StreamFacts:
        """See `Streams`.

        Raises:
            Missing: if the stream does not exist.
        """
        stream = self._stream(name)
        await self._stop(stream, "it was asked for")
        return stream.facts()

    async def set_options(self, name: str, options: Mapping[str, Any]) -> StreamFacts:
        """See `Streams`. A running stream is restarted with the new options.

        Raises:
            Missing: if the stream does not exist.
            Unprocessable: if an option is not valid.
        """
        stream = self._stream(name)
        wanted = replace(stream.wanted, options={**stream.wanted.options, **options})
        spec = self._spec(wanted)
        runs = stream.supervisor is not None
        await self._stop(stream, "its options change")
        stream.wanted, stream.spec = wanted, spec
        return await self.start(name) if runs else stream.facts()

    async def delete(self, name: str) -> None:
        """See `Streams`.

        Raises:
            Missing: if the stream does not exist.
        """
        await self._stop(self._stream(name), "it is deleted")
        self._streams.pop(name, None)

    async def set_camera(self, name: str, camera: Mapping[str, float]) -> Mapping[str, float]:
        """See `Streams`.

        Raises:
            Missing: if the stream does not exist.
            Conflicting: if the stream does not run or is just starting.
            BusError: if the engine does not answer.
        """
        return await self.with_engine(name).command("engine", "camera", **camera)

    def supervisor(self, name: str) -> StreamSupervisor:
        """Return the supervisor of a running stream.

        Raises:
            Missing: if the stream does not exist.
            Conflicting: if it is stopped.
        """
        supervisor = self._stream(name).supervisor
        if supervisor is None:
            raise Conflicting(f"the stream {name} is stopped; start it first")
        return supervisor

    def with_engine(self, name: str) -> StreamSupervisor:
        """Return the supervisor of a stream with a running engine, for a command.

        Raises:
            Missing: if the stream does not exist.
            Conflicting: if the engine does not run.
        """
        supervisor = self.supervisor(name)
        engine = supervisor.state().engine
        if engine.state != "running":
            raise Conflicting(
                f"the engine of {name} is {engine.state}: {engine.reason}; ask again when the stream is live"
            )
        return supervisor

    async def _stop(self, stream: Stream, reason: str) -> None:
        async with stream.changing:
            supervisor, hub = stream.supervisor, stream.hub
            stream.supervisor = stream.hub = None
            if hub is not None:
                await hub.close()
            if supervisor is not None:
                await supervisor.stop(reason)

    def _stream(self, name: str) -> Stream:
        if name not in self._streams:
            raise Missing("there is no stream with this name; GET /v1/streams lists them")
        return self._streams[name]

    def _spec(self, wanted: NewStream) -> StreamSpec:
        try:
            spec = spec_of(wanted)
        except InvalidSetting as error:
            raise Unprocessable(str(error)) from error
        others = [stream.spec for name, stream in self._streams.items() if name != wanted.name]
        return assigned([*others, spec], gpus())[-1]
