"""What the control plane is put together from: protocols, so that each part can be built, tested and left out by itself."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from fastapi import APIRouter
from prometheus_client.registry import Collector

from services.control.problems import Problem
from services.control.replay_parts import Jobs, Recordings
from services.control.snapshot_parts import Exports, Snapshots
from services.control.system_events import SystemEvents

PictureKind = Literal["raw", "shown", "depth", "confidence", "orbit"]
BOUNDARY = "picture"
"""Between the pictures of a multipart answer."""


class VersionRecord(Protocol):
    """A version of a model, as the registry has it."""

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def state(self) -> str: ...
    @property
    def reason(self) -> str | None: ...
    @property
    def digest(self) -> str: ...
    @property
    def size_bytes(self) -> int: ...
    @property
    def uploaded_at(self) -> Any: ...
    @property
    def uploaded_by(self) -> str: ...


class ModelRecord(Protocol):
    """A model: a name and which of its versions is active."""

    @property
    def name(self) -> str: ...
    @property
    def active(self) -> int | None: ...


class Models(Protocol):
    """The registry of models. Synchronous and safe for threads: the API calls it in one. Its errors are named in `Parts.errors`."""

    def upload(self, name: str, file: Path, digest: str | None, by: str) -> VersionRecord:
        """Keep a file as a new version; `digest` is its SHA-256 in hex, where somebody states it."""

    def check(self, name: str, version: int) -> VersionRecord:
        """Validate a version: afterwards it is ready, or rejected with a reason."""

    def models(self) -> Sequence[ModelRecord]: ...
    def versions(self, name: str) -> Sequence[VersionRecord]: ...
    def version(self, name: str, number: int) -> VersionRecord: ...
    def activate(self, name: str, version: int, expected_current: int | None, by: str) -> VersionRecord: ...
    def rollback(self, name: str, by: str) -> VersionRecord: ...
    def delete(self, name: str, version: int, by: str) -> object: ...


class StreamState(Protocol):
    """What a stream is and does."""

    @property
    def name(self) -> str: ...
    @property
    def source(self) -> str: ...
    @property
    def show(self) -> str: ...
    @property
    def device(self) -> str: ...
    @property
    def options(self) -> Mapping[str, Any]: ...
    @property
    def state(self) -> str:
        """`stopped`, `starting`, `live`, `stale`, `frozen`, `source lost` or `failed`."""

    @property
    def reason(self) -> str | None: ...
    @property
    def processes(self) -> Mapping[str, Mapping[str, Any]]:
        """Of capture and engine: state, pid, restarts, figures."""


@dataclass(frozen=True)
class NewStream:
    """What a caller asks for; its source was checked against the rules."""

    name: str
    source: str
    show: str
    device: str
    options: Mapping[str, Any]


class Streams(Protocol):
    """The streams and their processes."""

    async def all(self) -> Sequence[StreamState]: ...
    async def get(self, name: str) -> StreamState: ...
    async def create(self, stream: NewStream) -> StreamState: ...
    async def start(self, name: str) -> StreamState: ...
    async def stop(self, name: str) -> StreamState: ...
    async def set_options(self, name: str, options: Mapping[str, Any]) -> StreamState: ...
    async def delete(self, name: str) -> None: ...
    async def set_camera(self, name: str, camera: Mapping[str, float]) -> Mapping[str, float]:
        """Turn the stream's virtual camera; returns where it is."""


class EncodedPicture(Protocol):
    """A picture as viewers get it; it is made once for all of them."""

    @property
    def message(self) -> bytes:
        """As one message of a WebSocket: the length of the header in four bytes, big end first, the header in JSON, the JPEG."""

    @property
    def part(self) -> bytes:
        """As a part of a multipart answer with the boundary `BOUNDARY`."""


class Display(Protocol):
    """Pictures of the streams, newest wins: who reads slowly misses some."""

    def subscribe(
        self, stream: str, kind: PictureKind, quality: int
    ) -> AbstractAsyncContextManager[AsyncIterator[EncodedPicture]]:
        """A viewer while it is entered; its pictures end when the stream is gone."""


@dataclass(frozen=True)
class CheckResult:
    """How a part is. A service whose needed parts are well is ready; another one that is not makes it degraded."""

    ok: bool
    detail: str = ""
    needed: bool = True


@dataclass(frozen=True)
class Parts:
    """The parts of a server; requests for an absent one are answered with 503."""

    streams: Streams | None = None
    models: Models | None = None
    display: Display | None = None
    jobs: Jobs | None = None
    recordings: Recordings | None = None
    snapshots: Snapshots | None = None
    exports: Exports | None = None
    routers: Sequence[APIRouter] = ()
    """Further routes, made by `new_router`."""
    background: Sequence[Callable[[], AbstractAsyncContextManager[Any]]] = ()
    """Entered in order when the server starts, left in reverse when it has drained."""
    checks: Mapping[str, Callable[[], Awaitable[CheckResult]]] = field(default_factory=dict)
    """For /readyz, by name."""
    collectors: Sequence[Collector] = ()
    """For /metrics."""
    events: SystemEvents = field(default_factory=SystemEvents)
    """What the parts do by themselves, for the audit log."""
    trusts_ages: Callable[[], bool] = lambda: True
    """Whether files of the audit log may be removed now because they are old."""
    errors: Mapping[type[Exception], type[Problem]] = field(default_factory=dict)
    """What the parts' errors mean to a caller; their text is shown."""
