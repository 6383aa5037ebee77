"""Streams of a server: capture and engine process of each, state, display, and the registry model that it shows.

`StreamSupervisor` runs the two processes of one stream. `SupervisedStreams` holds all streams, `StreamDisplays` their viewers. `ShownModels` keeps streams in
step with the active versions of the registry.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from gsplat_core.errors import InvalidSetting
from services.api.parts import NewStream, PictureKind
from services.api.problems import Conflicting, Missing, Unprocessable
from services.audit.system_events import SystemEvents
from services.bus.messages import ANSWER_S
from services.bus.runtime import Role, RuntimeFolder, StreamFolder
from services.display.hub import KINDS, DisplayHub, EncodedPicture
from services.errors import BusError, RegistryError
from services.registry.models import ModelRegistry
from services.supervisor.launcher import ByLauncher, Direct, Start
from services.supervisor.process import ManagedProcess, ProcessState, StreamEvent
from services.supervisor.specs import StreamSpec, assigned
from services.supervisor.stream_specs import gpus, spec_of
from services.supervisor.worker import remove_dead


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

    async def stop(self, reason: str = "it was requested") -> None:
        """End both processes and remove the stream's runtime folder."""
        await self._engine.close(stop=True, reason=reason)
        await self._capture.close(stop=True, reason=reason)
        if self.folder.path.exists():
            self.folder.remove()

    async def detach(self, reason: str = "the control plane ends") -> None:
        """Stop supervising; the processes continue."""
        await asyncio.gather(*(each.close(stop=False, reason=reason) for each in (self._engine, self._capture)))

    async def restart(self, role: Role, reason: str = "it was requested") -> None:
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


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StreamFacts:
    """Configuration and current state of a stream.

    `state`: stopped, starting, live, stale, frozen, source lost or failed. `processes`: state, pid,
    restarts and figures of the capture and engine process.
    """

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
    """Streams and their processes. `running` is entered with the server."""

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
        """Return every stream."""
        return self.now()

    async def get(self, name: str) -> StreamFacts:
        """Return one stream.

        Raises:
            Missing: if the stream does not exist.
        """
        return self._stream(name).facts()

    async def create(self, stream: NewStream) -> StreamFacts:
        """Create a stream. It is stopped.

        Raises:
            Conflicting: if the name is taken or the limit is reached.
            Unprocessable: if the configuration is not valid.
        """
        if stream.name in self._streams:
            raise Conflicting(f"a stream named {stream.name} already exists; delete it first, or choose another name")
        if len(self._streams) >= self._most:
            raise Conflicting(f"there are {self._most} streams, which is limits.streams; delete one, or raise it")
        made = self._streams[stream.name] = Stream(stream, self._spec(stream))
        return made.facts()

    async def start(self, name: str) -> StreamFacts:
        """Start a stream. No effect on a running stream.

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
        """Stop a stream, including its raw picture.

        Raises:
            Missing: if the stream does not exist.
        """
        stream = self._stream(name)
        await self._stop(stream, "it was requested")
        return stream.facts()

    async def set_options(self, name: str, options: Mapping[str, Any]) -> StreamFacts:
        """Change options; unnamed options keep their values. A running stream is restarted with the new options.

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
        """Stop and delete a stream.

        Raises:
            Missing: if the stream does not exist.
        """
        await self._stop(self._stream(name), "it is deleted")
        self._streams.pop(name, None)

    async def set_camera(self, name: str, camera: Mapping[str, float]) -> Mapping[str, float]:
        """Set the stream's virtual camera and return its resulting position.

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


class StreamDisplays:
    """Pictures of streams for viewers. Slow viewers skip pictures and get the newest."""

    def __init__(self, streams: SupervisedStreams) -> None:
        self._streams = streams

    @asynccontextmanager
    async def subscribe(
        self, stream: str, kind: PictureKind, quality: int
    ) -> AsyncIterator[AsyncIterator[EncodedPicture]]:
        """Subscribe to the pictures of a stream. The iterator ends when the stream is deleted.

        Args:
            stream: name of the stream.
            kind: picture to receive.
            quality: JPEG quality.

        Raises:
            Conflicting: if the stream does not run.
        """
        hub = self._streams.hub(stream)
        if hub is None:
            raise Conflicting(f"the stream {stream} is stopped; start it first")
        async with hub.subscribe(kind, quality) as viewer:
            yield viewer


LOOK_S = 0.25
MOST_MS = 200.0
"""Time limit per picture in milliseconds. A model that repeatedly exceeds it is replaced by the
previous one."""
PREPARE_S = 60.0
"""Seconds allowed for loading a model and rendering its first picture."""
AGAIN_S = 5.0
"""Seconds before a refused request to an engine is repeated."""
GivenUp = tuple[tuple[str, int, str], ...]


@dataclass(frozen=True)
class ModelRequest:
    """Last request to an engine, and the models it had rolled back by then."""

    name: str
    version: int
    given_up_before: GivenUp


class ShownModels:
    """Polls four times a second that each stream displays its configured model. A restarted engine
    gets the request again."""

    def __init__(self, streams: SupervisedStreams, registry: ModelRegistry, events: SystemEvents | None = None) -> None:
        self._streams, self._registry = streams, registry
        self._events = events or SystemEvents()
        self._refused: dict[tuple[str, str, int], float] = {}
        """Time of an engine's refusal, by stream, model and version."""
        self._requests: dict[str, ModelRequest] = {}
        """Last request to each stream's engine."""

    @asynccontextmanager
    async def following(self) -> AsyncIterator[None]:
        """Synchronise while the block runs."""
        task = asyncio.create_task(self._follow(), name="shown models")
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def _follow(self) -> None:
        while True:
            for stream in self._streams.running_streams():
                try:
                    await self.look_at(stream)
                except (BusError, RegistryError) as error:
                    log.warning("%s does not show its model: %s", stream.wanted.name, error)
            await asyncio.sleep(LOOK_S)

    async def look_at(self, stream: Stream) -> None:
        """Make a stream display the active version of its model.

        Raises:
            BusError: if the engine does not answer.
            RegistryError: if the registry fails.
        """
        kind, _, name = stream.wanted.show.partition(" ")
        supervisor = stream.supervisor
        if kind != "model" or supervisor is None:
            return
        engine = supervisor.state().engine
        if engine.state != "running":
            return
        await self._roll_back_if_given_up(stream.wanted.name, engine.figures)
        active = await asyncio.to_thread(self._registry.active, name)
        shown = engine.figures.get("model") or {}
        if active is None or (shown.get("name"), shown.get("version")) == (name, active.version):
            return
        now_s, which = asyncio.get_running_loop().time(), (stream.wanted.name, name, active.version)
        if now_s - self._refused.get(which, -AGAIN_S) < AGAIN_S:
            return
        folder = await asyncio.to_thread(self._registry.folder_of, name, active.version)
        wanted = {"folder": str(folder), "version": active.version, "name": name, "most_ms": MOST_MS}
        try:
            await supervisor.command("engine", "show_model", timeout_s=PREPARE_S, **wanted)
        except BusError:
            self._refused[which] = now_s
            raise
        self._requests[stream.wanted.name] = ModelRequest(name, active.version, _given_up(engine.figures))
        log.info("%s shows %s/%d", stream.wanted.name, name, active.version)

    async def _roll_back_if_given_up(self, stream: str, figures: Mapping[str, Any]) -> None:
        """Roll back the active version if the engine reports that it cannot be displayed."""
        request, given_up = self._requests.get(stream), _given_up(figures)
        if request is None or given_up == request.given_up_before:
            return
        name, version, reason = given_up[-1]
        if (name, version) != (request.name, request.version):
            return
        del self._requests[stream]
        change = await asyncio.to_thread(
            self._registry.rollback, name, "engine", expected_current=version, reason=reason
        )
        self._events.tell("model.rollback", name, given_up=version, version=change.version, stream=stream)
        log.error("%s/%d was rolled back to %d: %s", name, version, change.version, reason)


def _given_up(figures: Mapping[str, Any]) -> GivenUp:
    """Return the models that an engine rolled back, newest last."""
    return tuple((each["name"], each["version"], each["reason"]) for each in figures.get("gave_way") or ())
