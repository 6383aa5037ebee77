"""Capture and engine processes: their specification, and their runtime with exclusive role, heartbeats, commands, orderly stop and priority."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType, TracebackType
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator

from gsplat_core.errors import InvalidSetting
from operators.options import Option, Section, options_for
from operators.settings import CallerCaptureOptions, CallerEngineOptions, check_stream_options
from operators.sources.registry import check_address
from services.bus.messages import CommandServer, Handler, Heartbeats
from services.bus.runtime import ProcessIdentity, Role, StreamFolder, read_json, write_json
from services.errors import BadMessage
from services.settings import StreamSettings

StreamName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
NVIDIA = Path("/proc/driver/nvidia/gpus")


@dataclass(frozen=True, kw_only=True)
class SourceSpec(CallerCaptureOptions):
    """Settings of a stream's capture process: the source and the size of its frames."""

    address: Annotated[str, Option("Source address in the format of `intrasplat live`", commands=(), least_length=1)]


@dataclass(frozen=True, kw_only=True)
class EngineSpec(CallerEngineOptions):
    """Reconstruction settings of a stream."""

    gpu: Annotated[
        int | None,
        Option("Index of the GPU (`CUDA_VISIBLE_DEVICES`)", commands=(), null="the first one", ge=0, le=1023),
    ] = None
    mps: Annotated[bool, Option("Use the GPU at the same time as other engines (`gpu.mps`)", commands=())] = False


class _Strict(BaseModel):
    """Base class of the specifications. Rejects unknown fields and type conversions, such as true for the number 1."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ProcessLimits(_Strict):
    """Time limits of stream processes, in seconds."""

    orphan_after_s: float = Field(default=0.0, ge=0)
    """Time for which a process continues after its supervisor has died, so that the next supervisor can adopt it."""
    drain_s: float = Field(default=10.0, gt=0)
    """Time from a stop request until a process that still runs is killed."""
    start_s: float = Field(default=120.0, gt=0)
    """Time allowed from the start of a process to its first heartbeat."""
    heartbeat_s: float = Field(default=3.0, gt=0)
    """Time without heartbeats after which the supervisor kills a process as hung."""
    hung_s: float = Field(default=10.0, gt=0)
    """Time without a published picture after which an engine counts as hung, once it has published its first
    picture. A working engine at least repeats its last picture."""


class ProcessSpec(_Strict):
    """Specification of one process of a stream, written to a file by the supervisor and read by the process.

    Exactly one of `capture` and `engine` is given. Construction raises pydantic's ValidationError for invalid values.
    """

    stream: StreamName
    capture: SourceSpec | None = None
    engine: EngineSpec | None = None
    limits: ProcessLimits = ProcessLimits()
    supervisor: dict[str, int | str] | None = None
    """Identity of the process that wrote the file; None until `write` sets it in the file."""

    @model_validator(mode="after")
    def _for_one_role(self) -> ProcessSpec:
        if (self.capture is None) == (self.engine is None):
            raise ValueError("give either capture or engine")
        return self

    @property
    def role(self) -> Role:
        """Return the role of the process."""
        return "engine" if self.capture is None else "capture"

    @property
    def digest(self) -> str:
        """Return a digest of the settings. A running process with another digest has to be restarted."""
        return hashlib.sha256(repr(self._content()).encode()).hexdigest()

    def _content(self) -> dict[str, Any]:
        part = self.capture or self.engine
        assert part is not None
        return {"stream": self.stream, self.role: asdict(part), "limits": self.limits.model_dump(mode="json")}

    def write(self, folder: StreamFolder) -> Path:
        """Write the file, readable by its owner only because the address may contain a password."""
        path = folder.spec(self.role)
        write_json(path, {**self._content(), "supervisor": asdict(ProcessIdentity.own())})
        return path

    @staticmethod
    def read(path: Path, role: Role) -> ProcessSpec:
        """Read a file written by `write`.

        Raises:
            InvalidSetting: if the file is unreadable, invalid or for another role.
        """
        try:
            spec = ProcessSpec.model_validate(read_json(path))
        except OSError as error:
            raise InvalidSetting(f"{path} cannot be read: {error.strerror}") from None
        except BadMessage as error:
            raise InvalidSetting(f"{path} is damaged: {error}") from None
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise InvalidSetting(f"{path}: {where}: {first['msg']}") from None
        if spec.role != role:
            raise InvalidSetting(f"{path} is for the {spec.role} process, and this is the {role} process")
        return spec


def specs_of(name: str, stream: StreamSettings, limits: ProcessLimits | None = None) -> dict[Role, ProcessSpec]:
    """Build the specifications of a stream's processes from its settings.

    Raises:
        InvalidSetting: if an option is unknown or out of range, or the source cannot be opened.
    """
    check_stream_options(stream.options)
    options = {name: value for name, value in stream.options.items() if value is not None}
    check_address(stream.source)
    kind, _, number = stream.device.partition(":")
    if kind == "auto":
        kind = "cuda" if gpus() else "cpu"

    def of(section: type[Section]) -> dict[str, Any]:
        return {name: value for name, value in options.items() if name in options_for(section, "stream")}

    device: Any = kind
    engine = EngineSpec(device=device, gpu=int(number) if number else None, **of(EngineSpec))
    source = SourceSpec(address=stream.source, **of(SourceSpec))
    limits = limits or ProcessLimits()
    return {
        "capture": ProcessSpec(stream=name, capture=source, limits=limits),
        "engine": ProcessSpec(stream=name, engine=engine, limits=limits),
    }


def gpus() -> int:
    """Return the number of NVIDIA GPUs from the driver's files, without loading a library."""
    return len(list(NVIDIA.iterdir())) if NVIDIA.is_dir() else 0


def assigned(engine: EngineSpec, others: list[EngineSpec], gpus: int) -> EngineSpec:
    """Assign the least loaded GPU to a CUDA engine that names none.

    Args:
        engine: the engine.
        others: engines of the other streams.
        gpus: number of GPUs.
    """
    if gpus < 1 or engine.device != "cuda" or engine.gpu is not None:
        return engine
    load = [0] * gpus
    for each in others:
        if each.device == "cuda" and each.gpu is not None and each.gpu < gpus:
            load[each.gpu] += 1
    return replace(engine, gpu=load.index(min(load)))


ENGINE_ON_CPU = 5
"""Nice value of an engine that trains on the CPU, which uses all available time. Capture, viewers
and commands need little and run first."""


def step_back(nice: int) -> None:
    """Lower the priority of this process.

    With `sched_autogroup_enabled` Linux applies nice values only within a session, and each stream
    process has its own session. The session's priority is therefore lowered too.

    Args:
        nice: nice value to reach.
    """
    os.nice(max(0, nice - os.nice(0)))
    with contextlib.suppress(OSError):  # no autogroups on this system, or read-only in this container
        Path("/proc/self/autogroup").write_text(str(nice), encoding="ascii")


PREFIX = "intrasplat-engine-"
NEW_S = 2.0
"""Age in seconds below which a scratch folder may belong to a process that has not locked it yet."""


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Create a scratch folder and make it the default of `tempfile` in this process. Scratch folders of killed
    engines are removed first."""
    remove_dead()
    before = tempfile.tempdir
    folder = Path(tempfile.mkdtemp(prefix=PREFIX))
    held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        tempfile.tempdir = os.fspath(folder)
        yield folder
    finally:
        tempfile.tempdir = before
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def remove_dead() -> list[Path]:
    """Delete this user's scratch folders that are older than `NEW_S` and whose process has ended.

    Returns:
        The deleted folders.
    """
    removed = []
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        try:
            held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except OSError:  # owned by another user, a symbolic link, or already removed
            continue
        try:
            found = os.fstat(held)
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if found.st_uid == os.geteuid() and time.time() - found.st_mtime > NEW_S:
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder)
        except BlockingIOError:
            continue
        finally:
            os.close(held)
    return removed


log = logging.getLogger(__name__)
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
POLL_S = 0.25
MEASURED_EVERY_S = 1.0
ORPHAN_DRAIN_S = 1.25
"""Largest time in seconds that a process without supervisor may take to finish before it is terminated."""


class Parent:
    """Liveness check of this process's supervisor. A `ping` of another supervisor replaces the identity.

    The supervisor need not be the parent process, because the launcher forks stream processes. The death of the
    supervisor is therefore detected by its process identity, not by a parent-death signal.
    """

    def __init__(self, identity: ProcessIdentity | None, patience_s: float) -> None:
        """Start to watch the supervisor's process.

        Args:
            identity: the supervisor; None for a process that is run by hand.
            patience_s: seconds after the supervisor's death in which a new supervisor may adopt this process.
        """
        self.identity = identity
        self._patience_s = patience_s
        self._dead_since_s: float | None = None

    def lost(self, now_s: float) -> bool:
        """Return True if the supervisor has been dead for `patience_s`."""
        if self.identity is None or self.identity.is_alive:
            self._dead_since_s = None
            return False
        if self._dead_since_s is None:
            self._dead_since_s = now_s
        return now_s - self._dead_since_s >= self._patience_s


def identity_of(content: Any) -> ProcessIdentity:
    """Return the process identity in a message.

    Raises:
        BadMessage: if the content is malformed.
    """
    try:
        return ProcessIdentity(int(content["pid"]), str(content["started"]))
    except (KeyError, TypeError, ValueError) as error:
        raise BadMessage(f"{content!r:.80} is no identity of a process") from error


class Worker:
    """Context manager for the runtime of a stream process: lock of its role, heartbeats, commands, signals.

    `say` sets the state in the heartbeats. `stop_requested` returns True after a stop command, a
    signal, or the death of the supervisor. A process that does not finish within `drain_s` is
    terminated, and an orphan within `ORPHAN_DRAIN_S`.

    Raises:
        AlreadyRunning: if another process serves this role.
    """

    def __init__(self, folder: StreamFolder, spec: ProcessSpec, handlers: Mapping[str, Handler] | None = None) -> None:
        """Prepare the runtime of a stream's process.

        Args:
            folder: runtime folder of the stream.
            spec: specification of this process.
            handlers: commands in addition to `ping` and `stop`.
        """
        self.folder, self.spec, self.role = folder, spec, spec.role
        supervisor = None if spec.supervisor is None else identity_of(spec.supervisor)
        self._parent = Parent(supervisor, spec.limits.orphan_after_s)
        own: dict[str, Handler] = {"ping": self._pinged, "stop": self._told_to_stop}
        self._handlers = {**own, **(handlers or {})}
        self._stop = threading.Event()
        self._over = threading.Event()
        self._saying = threading.Lock()
        self._said: dict[str, Any] = {"state": "starting", "reason": f"the {spec.role} process starts"}
        self._figures: dict[str, Callable[[], Mapping[str, Any]]] = {}
        self._measures: dict[str, Callable[[], Mapping[str, Any]]] = {}
        self._measured: dict[str, Any] = {}
        self._measured_s = -MEASURED_EVERY_S
        self.stop_reason = ""

    def __enter__(self) -> Worker:
        self._lock = self.folder.lock(self.role)
        self.folder.clean(self.role)
        self._before = {number: signal.signal(number, self._signalled) for number in SIGNALS}
        self._heartbeats = Heartbeats(self.folder.status(self.role), self._report)
        self._commands = CommandServer(self.folder.commands(self.role), self._handlers)
        self.folder.write_record(self.role, self.spec.digest)
        self._watch = threading.Thread(target=self._watch_loop, name="watch", daemon=True)
        self._watch.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.say("ended", self.stop_reason or "it has nothing more to do")
        else:
            self.say("failed", str(error) or type(error).__name__)
        self._over.set()
        self._watch.join()
        self._commands.close()
        self._heartbeats.close()
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self.folder.clean(self.role)
        os.close(self._lock)

    def take(self, handlers: Mapping[str, Handler]) -> None:
        """Add handlers of further commands."""
        self._handlers.update(handlers)

    def say(self, state: str, reason: str) -> None:
        """Set the state and reason that the heartbeats report. A changed state is logged and published at once."""
        with self._saying:
            changed = self._said["state"] != state or (state == "starting" and self._said["reason"] != reason)
            self._said = {"state": state, "reason": reason[:2000]}
        if changed:
            log.info("%s: %s", state, reason)
            self._heartbeats.say_now()

    def tell_figures(self, part: str, figures: Callable[[], Mapping[str, Any]]) -> None:
        """Register a callable whose counters are part of each heartbeat. The heartbeat thread calls it."""
        self._figures[part] = figures

    def tell_measures(self, part: str, measures: Callable[[], Mapping[str, Any]]) -> None:
        """Register a callable whose Prometheus measures are part of the heartbeats. The heartbeat thread calls it
        once per second."""
        self._measures[part] = measures

    def stop_requested(self) -> bool:
        """Return True if the process should finish."""
        return self._stop.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait for a time in seconds. Returns True as soon as a stop is requested."""
        return self._stop.wait(seconds)

    def request_stop(self, reason: str) -> None:
        """Request an orderly stop of this process. The reason of the first request is kept."""
        if not self._stop.is_set():
            self.stop_reason = reason
            self._stop.set()

    def _signalled(self, number: int, frame: FrameType | None) -> None:
        self.request_stop(f"it got {signal.Signals(number).name}")

    def _pinged(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `ping`: adopt the supervisor identity in the arguments, and return the process id."""
        if "supervisor" in arguments:
            self._parent.identity = identity_of(arguments["supervisor"])
        return {"pid": os.getpid()}

    def _told_to_stop(self, arguments: Mapping[str, Any]) -> None:
        self.request_stop(str(arguments.get("reason", "a stop was requested"))[:200])

    def _report(self) -> Mapping[str, Any]:
        with self._saying:
            said = dict(self._said)
        figures = {name: value for part in list(self._figures.values()) for name, value in part().items()}
        return {"role": self.role, **said, "figures": figures, "measures": self._newest_measures()}

    def _newest_measures(self) -> Mapping[str, Any]:
        now_s = time.monotonic()
        if now_s - self._measured_s >= MEASURED_EVERY_S:
            self._measured_s = now_s
            self._measured = {name: value for part in list(self._measures.values()) for name, value in part().items()}
        return self._measured

    def _watch_loop(self) -> None:
        drain_s = self.spec.limits.drain_s
        asked_s: float | None = None
        while not self._over.wait(POLL_S):
            now_s = time.monotonic()
            if self._parent.lost(now_s):
                self.request_stop("its supervisor has died")
                drain_s = min(drain_s, ORPHAN_DRAIN_S)
            if self._stop.is_set():
                asked_s = asked_s or now_s
                if now_s - asked_s > drain_s:
                    log.error("not finished within %g s; ended", drain_s)
                    self.folder.clean(self.role)
                    os._exit(1)
