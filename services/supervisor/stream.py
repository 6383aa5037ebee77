"""Streams of a server: capture and engine process of each, state, viewers, and the registry model that it shows.

`Stream` runs the two processes of one stream. `SupervisedStreams` holds all streams. `ShownModels` displays the active
registry versions on the streams.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

from gsplat_core.errors import InvalidSetting
from services.audit.log import SystemEvents
from services.bus.runtime import Role, RuntimeFolder, StreamFolder
from services.display import KINDS, DisplayHub, EncodedPicture, PictureKind
from services.errors import BusError, Conflict, NotFound, RegistryError, Rejected
from services.registry.models import ModelRegistry
from services.schemas import StreamView
from services.settings import StreamSettings
from services.supervisor.gpu_sharing import WithMps, end_mps
from services.supervisor.launcher import ByLauncher, Direct, Start
from services.supervisor.process import ManagedProcess, ProcessState, StreamEvent
from services.supervisor.worker import ProcessLimits, ProcessSpec, assigned, gpus, remove_dead, specs_of

log = logging.getLogger(__name__)


class Stream:
    """Stream, with its processes and display hub while it runs. Runs in the creator's event loop and loads no torch.

    stream = Stream(settings, specs_of("theatre-1", settings), RuntimeFolder(path), on_event=audit)
    await stream.start()      # adopts running processes
    stream.engine.state
    await stream.stop("…")
    """

    def __init__(
        self,
        settings: StreamSettings,
        specs: Mapping[Role, ProcessSpec],
        runtime: RuntimeFolder,
        *,
        start: Start | None = None,
        on_event: Callable[[StreamEvent], None] = lambda event: None,
    ) -> None:
        """Create a stopped stream.

        Args:
            settings: settings of the stream.
            specs: specifications of its processes.
            runtime: runtime folder of the service.
            start: process starter; None for `Direct`. `ByLauncher` restarts engines quickly and is shared by the streams of
                a runtime folder.
            on_event: called for each state change of a process.
        """
        self.settings, self.specs = settings, specs
        self.name = specs["engine"].stream
        self._runtime, self._start, self._on_event = runtime, start or Direct(), on_event
        self.processes: dict[Role, ManagedProcess] = {}
        """Processes by role; empty while the stream is stopped."""
        self.hub: DisplayHub | None = None
        """Pictures for viewers; None while the stream is stopped."""
        self.model_fault: str | None = None
        """Reason why the configured model is not shown; None if it is, or if none is configured."""
        self.changing = asyncio.Lock()
        """Held during start, stop and configuration changes, so that they do not overlap."""

    @property
    def engine(self) -> ManagedProcess:
        """Return the engine process of a running stream."""
        return self.processes["engine"]

    @property
    def capture(self) -> ManagedProcess:
        """Return the capture process of a running stream."""
        return self.processes["capture"]

    @property
    def folder(self) -> StreamFolder:
        """Return the runtime folder of the stream, created if missing.

        Raises:
            RuntimeFolderUnusable: if the folder cannot be used.
        """
        return self._runtime.stream(self.name)

    async def start(self) -> None:
        """Adopt running processes with the same settings, start the missing ones, and supervise them.
        No effect on a running stream.

        Raises:
            RuntimeFolderUnusable: if the runtime folder cannot be used.
        """
        if self.hub is not None:
            return
        folder = self.folder
        self.processes = {
            role: ManagedProcess(spec, folder, self._start, self._on_event) for role, spec in self.specs.items()
        }
        for process in self.processes.values():
            process.open()
        self.hub = DisplayHub(folder)

    async def stop(self, reason: str = "it was requested") -> None:
        """End both processes and remove the stream's runtime folder. No effect on a stopped stream."""
        hub, processes = self.hub, self.processes
        self.hub, self.processes = None, {}
        if hub is None:
            return
        await hub.close()
        for role in ("engine", "capture"):
            await processes[role].close(reason)
        if (self._runtime.path / self.name).exists():
            self.folder.remove()

    def view(self) -> StreamView:
        """Return the configuration and the current state of the stream, as the API's record."""
        engine = self.specs["engine"].engine
        assert engine is not None
        state, reason = "stopped", None
        if self.processes:
            state, reason = overall(self.capture.state, self.engine.state)
            if reason is None and self.model_fault is not None:
                reason = f"the {self.settings.show} is not shown: {self.model_fault}"
        return StreamView(
            name=self.name,
            source=self.settings.source,
            show=self.settings.show,
            device=engine.device if engine.gpu is None else f"{engine.device}:{engine.gpu}",
            options=self.settings.options,
            state=state,
            reason=reason,
            processes={role: asdict(process.state) for role, process in self.processes.items()},
            viewers={} if self.hub is None else {kind: self.hub.viewers(kind) for kind in KINDS},
        )


CHECK_SOURCE = "check what the source sends"
REMEDIES = {
    "out of body": "the stream's option out_of_body: off lets those out of body pass",
    "no tissue": "the stream's option tool_mask: none takes every pixel for tissue",
    "tool mask lost": "the stream's option tool_mask: none takes every pixel for tissue",
    "damaged": "check the connection of the source",
    **dict.fromkeys(("black", "one colour", "noise", "duplicate", "frozen", "torn", "out of order"), CHECK_SOURCE),
}
"""Remedy for the user by reason of withheld frames, for reasons that do not pass by themselves."""
WITHHELD_FRAMES = 5
"""Number of consecutive withheld frames from which they are stated as the reason for a stale picture."""


def overall(capture: ProcessState, engine: ProcessState) -> tuple[str, str | None]:
    """Derive the state of a stream, and its reason, from the states of its two processes. The reason is None if there
    is none to state, as for a live stream.
    """
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
    if shown in ("live", "behind"):
        return str(shown), None
    if shown in ("stale", "frozen", "source lost"):
        return str(shown), _withheld_now(engine)
    return "starting", _withheld(engine) or "the first picture is being made"


def _withheld(engine: ProcessState) -> str | None:
    """Return the counts of withheld frames by reason, as a sentence about a running engine that has displayed no
    picture; None if no frame was withheld.
    """
    frames, withheld = engine.figures.get("frames"), engine.figures.get("withheld")
    if not frames or not isinstance(withheld, Mapping) or not withheld:
        return None
    return f"nothing is shown: of {frames} frames {sum(withheld.values())} were withheld {_counts(withheld)}"


def _withheld_now(engine: ProcessState) -> str | None:
    """Return the counts of the newest frames by the reason for withholding them, as a sentence about a displayed
    picture that is old; None if the newest `WITHHELD_FRAMES` frames were not all withheld.
    """
    withheld = engine.figures.get("withheld_now")
    if not isinstance(withheld, Mapping) or sum(withheld.values()) < WITHHELD_FRAMES:
        return None
    return f"nothing new is shown: the last {sum(withheld.values())} frames were withheld {_counts(withheld)}"


def _counts(withheld: Mapping[str, int]) -> str:
    """Return counts of withheld frames by reason, most frequent first, and the remedies."""
    ordered = sorted(withheld.items(), key=lambda each: -each[1])
    counts = ", ".join(f"{reason}: {count}" for reason, count in ordered)
    return "; ".join([f"({counts})", *dict.fromkeys(REMEDIES[reason] for reason, _ in ordered if reason in REMEDIES)])


class SupervisedStreams:
    """Streams of a server by name. The server enters the context manager `running` at its start."""

    def __init__(
        self,
        runtime: RuntimeFolder,
        on_event: Callable[[StreamEvent], None],
        most: int = 16,
        takeover_s: float = 0.0,
        *,
        mps: bool = False,
    ) -> None:
        """Create the manager without streams.

        Args:
            runtime: runtime folder of the service.
            on_event: receives process events.
            most: limit on the number of streams, including stopped ones (`limits.streams`).
            takeover_s: time for which processes continue after this process has died (`server.takeover_s`).
            mps: engines on one GPU compute at the same time (`gpu.mps`).
        """
        self._runtime, self._on_event, self._most = runtime, on_event, most
        self._limits = ProcessLimits(orphan_after_s=takeover_s)
        self._launcher = ByLauncher(runtime, takeover_s)
        self._mps = WithMps(self._launcher, runtime) if mps else None
        self._streams: dict[str, Stream] = {}

    @asynccontextmanager
    async def running(self, at_start: Mapping[str, StreamSettings]) -> AsyncIterator[None]:
        """Create the streams `at_start` and start those whose settings have `start`. Stop all streams at the end of
        the block."""
        await asyncio.to_thread(remove_dead)
        for name, settings in at_start.items():
            self.create(name, settings)
        for name, settings in at_start.items():
            if settings.start:
                await self.start(name)
        try:
            yield
        finally:
            await asyncio.gather(*(self._stop(stream, "the server ends") for stream in self._streams.values()))
            await self._launcher.close(stop=True)
            await end_mps(self._runtime)
            await asyncio.to_thread(remove_dead)

    def streams(self) -> Sequence[Stream]:
        """Return the `Stream` objects, for components that send commands to their processes."""
        return list(self._streams.values())

    def all(self) -> Sequence[StreamView]:
        """Return the state of every stream."""
        return [stream.view() for stream in self._streams.values()]

    def get(self, name: str) -> StreamView:
        """Return the state of one stream.

        Raises:
            NotFound: if the stream does not exist.
        """
        return self._stream(name).view()

    def create(self, name: str, settings: StreamSettings) -> StreamView:
        """Create a stream. It is stopped.

        Raises:
            Conflict: if the name is taken or the limit is reached.
            Rejected: if the configuration is not valid.
        """
        if name in self._streams:
            raise Conflict(f"a stream named {name} already exists; delete it first, or choose another name")
        if len(self._streams) >= self._most:
            raise Conflict(f"there are {self._most} streams, which is limits.streams; delete one, or raise it")
        specs = self._specs(name, settings)
        engine = specs["engine"].engine
        made = self._streams[name] = Stream(
            settings,
            specs,
            self._runtime,
            start=self._mps if self._mps is not None and engine is not None and engine.mps else self._launcher,
            on_event=self._on_event,
        )
        return made.view()

    async def start(self, name: str) -> StreamView:
        """Start a stream. No effect on a running stream.

        Raises:
            NotFound: if the stream does not exist.
        """
        async with self._changing(name) as stream:
            await self._start(stream)
        return stream.view()

    async def stop(self, name: str) -> StreamView:
        """Stop a stream, including its raw picture.

        Raises:
            NotFound: if the stream does not exist.
        """
        async with self._changing(name) as stream:
            await stream.stop("it was requested")
        return stream.view()

    async def set_options(self, name: str, options: Mapping[str, Any]) -> StreamView:
        """Change options; unnamed options keep their values. A running stream is restarted with the new options.

        Raises:
            NotFound: if the stream does not exist.
            Rejected: if an option is not valid.
        """
        async with self._changing(name) as stream:
            settings = stream.settings.model_copy(update={"options": {**stream.settings.options, **options}})
            specs = self._specs(name, settings)
            runs = stream.hub is not None
            await stream.stop("its options change")
            stream.settings, stream.specs = settings, specs
            if runs:
                await self._start(stream)
        return stream.view()

    async def delete(self, name: str) -> None:
        """Stop and delete a stream.

        Raises:
            NotFound: if the stream does not exist.
        """
        async with self._changing(name) as stream:
            await stream.stop("it is deleted")
            del self._streams[name]

    async def set_camera(self, name: str, camera: Mapping[str, float]) -> Mapping[str, float]:
        """Set the stream's virtual camera and return its resulting position.

        Raises:
            NotFound: if the stream does not exist.
            Conflict: if the stream does not run or is just starting.
            BusError: if the engine does not answer.
        """
        return await self.engine(name).command("camera", **camera)

    def engine(self, name: str) -> ManagedProcess:
        """Return the running engine of a stream, for a command.

        Raises:
            NotFound: if the stream does not exist.
            Conflict: if the engine does not run.
        """
        stream = self._stream(name)
        if not stream.processes:
            raise self._is_stopped(name)
        state = stream.engine.state
        if state.state != "running":
            raise Conflict(f"the engine of {name} is {state.state}: {state.reason}; ask again when the stream is live")
        return stream.engine

    @asynccontextmanager
    async def subscribe(
        self, name: str, kind: PictureKind, quality: int
    ) -> AsyncIterator[AsyncIterator[EncodedPicture]]:
        """Subscribe to the pictures of a stream. A slow viewer skips pictures and gets the newest. The
        iterator ends when the stream is stopped.

        Args:
            name: name of the stream.
            kind: picture to receive.
            quality: JPEG quality.

        Raises:
            NotFound: if the stream does not exist.
            Conflict: if the stream does not run.
        """
        hub = self._stream(name).hub
        if hub is None:
            raise self._is_stopped(name)
        async with hub.subscribe(kind, quality) as viewer:
            yield viewer

    def _is_missing(self) -> NotFound:
        return NotFound("there is no stream with this name; GET /v1/streams lists them")

    def _is_stopped(self, name: str) -> Conflict:
        return Conflict(f"the stream {name} is stopped; start it first")

    @asynccontextmanager
    async def _changing(self, name: str) -> AsyncIterator[Stream]:
        """Hold the lock of a stream for a change.

        Raises:
            NotFound: if the stream does not exist, or was deleted while this call waited for the lock. Its processes must not
                be started then, because nothing would stop them.
        """
        stream = self._stream(name)
        async with stream.changing:
            if self._streams.get(name) is not stream:
                raise self._is_missing()
            yield stream

    async def _start(self, stream: Stream) -> None:
        self._launcher.open()  # not before the first stream, because preloaded modules take memory
        await stream.start()

    async def _stop(self, stream: Stream, reason: str) -> None:
        async with stream.changing:
            await stream.stop(reason)

    def _stream(self, name: str) -> Stream:
        if name not in self._streams:
            raise self._is_missing()
        return self._streams[name]

    def _specs(self, name: str, settings: StreamSettings) -> dict[Role, ProcessSpec]:
        try:
            specs = specs_of(name, settings, self._limits)
        except InvalidSetting as error:
            raise Rejected(str(error)) from error
        others = [each.specs["engine"].engine for other, each in self._streams.items() if other != name]
        engine = specs["engine"].engine
        assert engine is not None
        placed = assigned(engine, [each for each in others if each is not None], gpus())
        placed = replace(placed, mps=self._mps is not None and placed.device == "cuda")
        if (
            placed.gpu is not None
            and self._mps is None
            and placed.gpu in [each.gpu for each in others if each is not None]
        ):
            log.warning(
                "%s and other streams take turns on GPU %d; gpu.mps: true lets them compute at the same time (docs/operations.md)",
                name,
                placed.gpu,
            )
        return {**specs, "engine": specs["engine"].model_copy(update={"engine": placed})}


POLL_S = 0.25
MOST_MS = 200.0
"""Time limit per picture in milliseconds. A model that repeatedly exceeds it is replaced by the previous model."""
PREPARE_S = 60.0
"""Seconds allowed for loading a model and rendering its first picture."""
AGAIN_S = 5.0
"""Seconds after which `show_model` is sent again to an engine that refused it."""
GivenUp = tuple[tuple[str, int, str], ...]


@dataclass(frozen=True)
class ModelRequest:
    """Last `show_model` command to an engine, with the rollbacks that the engine had reported before it."""

    name: str
    version: int
    given_up_before: GivenUp


class ShownModels:
    """Keeps each stream on the active version of its configured registry model, by polling four times per second. A
    restarted engine receives `show_model` again."""

    def __init__(self, streams: SupervisedStreams, registry: ModelRegistry, events: SystemEvents | None = None) -> None:
        self._streams, self._registry = streams, registry
        self._events = events or SystemEvents()
        self._refused: dict[tuple[str, str, int], float] = {}
        """Time at which an engine refused `show_model`, by stream, model and version."""
        self._requests: dict[str, ModelRequest] = {}
        """Last `show_model` command by stream, until its model is rolled back."""
        self._without_earlier: dict[str, tuple[str, int, str]] = {}
        """Name, version and reason of a model that an engine gave up and that has no earlier version, by stream."""

    @asynccontextmanager
    async def following(self) -> AsyncIterator[None]:
        """Poll all streams while the block runs."""
        task = asyncio.create_task(self._follow(), name="shown models")
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def _follow(self) -> None:
        while True:
            for stream in self._streams.streams():
                await self.follow(stream)
            await asyncio.sleep(POLL_S)

    async def follow(self, stream: Stream) -> None:
        """Call `show_active`, and note and log why it failed. The log has each reason once, not at every poll."""
        try:
            await self.show_active(stream)
        except (BusError, RegistryError) as error:
            if stream.model_fault != str(error):
                log.warning("%s does not show its model: %s", stream.name, error)
            stream.model_fault = str(error)

    async def show_active(self, stream: Stream) -> None:
        """Send `show_model` to a running engine if it does not display the active version of the stream's configured model.
        A version that it refused is sent again after `AGAIN_S` seconds.

        Raises:
            BusError: if the engine does not answer.
            RegistryError: if the registry fails.
        """
        kind, _, name = stream.settings.show.partition(" ")
        if kind != "model" or not stream.processes:
            return
        process = stream.engine
        engine = process.state
        if engine.state != "running":
            return
        await self._roll_back_if_given_up(stream.name, engine.figures)
        active = await asyncio.to_thread(self._registry.active, name)
        if active is None:
            stream.model_fault = f"no version of {name!r} is active; activate one"
            return
        shown = engine.figures.get("model") or {}
        if (shown.get("name"), shown.get("version")) == (name, active.version):
            stream.model_fault = None
            return
        if self._is_held_back(stream.name, name, active.version, engine.figures):
            *_, reason = self._without_earlier[stream.name]
            stream.model_fault = (
                f"{name}/{active.version} was given up ({reason}) and has no earlier version; activate another version,"
                " or restart the stream to try it again"
            )
            return
        now_s, which = asyncio.get_running_loop().time(), (stream.name, name, active.version)
        if now_s - self._refused.get(which, -AGAIN_S) < AGAIN_S:
            return
        folder = await asyncio.to_thread(self._registry.folder_of, name, active.version)
        wanted = {"folder": str(folder), "version": active.version, "name": name, "most_ms": MOST_MS}
        try:
            await process.command("show_model", timeout_s=PREPARE_S, **wanted)
        except BusError:
            self._refused[which] = now_s
            raise
        self._requests[stream.name] = ModelRequest(name, active.version, _given_up(engine.figures))
        log.info("%s shows %s/%d", stream.name, name, active.version)

    async def _roll_back_if_given_up(self, stream: str, figures: Mapping[str, Any]) -> None:
        """Roll back a stream's model in the registry if the engine reports that it stopped displaying the active
        version.
        """
        request, given_up = self._requests.get(stream), _given_up(figures)
        if request is None or given_up == request.given_up_before:
            return
        name, version, reason = given_up[-1]
        if (name, version) != (request.name, request.version):
            return
        del self._requests[stream]
        try:
            change = await asyncio.to_thread(
                self._registry.rollback, name, "engine", expected_current=version, reason=reason
            )
        except Conflict:
            self._without_earlier[stream] = given_up[-1]
            raise
        self._events.tell("model.rollback", name, given_up=version, version=change.version, stream=stream)
        log.error("%s/%d was rolled back to %d: %s", name, version, change.version, reason)

    def _is_held_back(self, stream: str, name: str, version: int, figures: Mapping[str, Any]) -> bool:
        """Return True if the stream's running engine gave up this version, which has no earlier one. It would give it up again."""
        held = self._without_earlier.get(stream)
        if held is None:
            return False
        if held in _given_up(figures) and held[:2] == (name, version):
            return True
        del self._without_earlier[stream]  # another version is active, or the engine is a new one
        return False


def _given_up(figures: Mapping[str, Any]) -> GivenUp:
    """Return name, version and reason of the models that an engine stopped displaying after failures, newest last."""
    return tuple((each["name"], each["version"], each["reason"]) for each in figures.get("gave_way") or ())
