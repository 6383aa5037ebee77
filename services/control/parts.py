"""Protocols of the parts of a server. Each part can be built, tested and omitted separately."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from fastapi import APIRouter
from prometheus_client.registry import Collector

from services.audit.system_events import SystemEvents
from services.control.problems import Problem
from services.control.replay_parts import Jobs, Recordings
from services.control.snapshot_parts import Exports, Snapshots

PictureKind = Literal["raw", "shown", "depth", "confidence", "orbit"]
BOUNDARY = "picture"
"""Boundary between the pictures of a multipart answer."""


class VersionRecord(Protocol):
    """Registry record of one model version."""

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
    """Registry record of a model: its name and the active version."""

    @property
    def name(self) -> str: ...
    @property
    def active(self) -> int | None: ...


class Models(Protocol):
    """Model registry. Synchronous and thread-safe; the API calls it in worker threads.
    `Parts.errors` names its errors."""

    def upload(self, name: str, file: Path, digest: str | None, by: str) -> VersionRecord:
        """Store a file as a new version.

        Args:
            name: the model.
            file: the bundle to store.
            digest: its SHA-256 in hex, if the caller states one.
            by: the caller, for the record.
        """

    def check(self, name: str, version: int) -> VersionRecord:
        """Validate a version and mark it ready, or rejected with a reason."""

    def models(self) -> Sequence[ModelRecord]: ...
    def versions(self, name: str) -> Sequence[VersionRecord]: ...
    def version(self, name: str, number: int) -> VersionRecord: ...
    def activate(self, name: str, version: int, expected_current: int | None, by: str) -> VersionRecord: ...
    def rollback(self, name: str, by: str) -> VersionRecord: ...
    def delete(self, name: str, version: int, by: str) -> object: ...


class StreamState(Protocol):
    """Configuration and current state of a stream."""

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
        """Return `stopped`, `starting`, `live`, `stale`, `frozen`, `source lost` or `failed`."""

    @property
    def reason(self) -> str | None: ...
    @property
    def processes(self) -> Mapping[str, Mapping[str, Any]]:
        """Return state, pid, restarts and figures of the capture and engine process."""


@dataclass(frozen=True)
class NewStream:
    """Stream requested by a caller; the source already passed the source rules."""

    name: str
    source: str
    show: str
    device: str
    options: Mapping[str, Any]


class Streams(Protocol):
    """Streams and their processes, as managed by the supervisor."""

    async def all(self) -> Sequence[StreamState]: ...
    async def get(self, name: str) -> StreamState: ...
    async def create(self, stream: NewStream) -> StreamState: ...
    async def start(self, name: str) -> StreamState: ...
    async def stop(self, name: str) -> StreamState: ...
    async def set_options(self, name: str, options: Mapping[str, Any]) -> StreamState: ...
    async def delete(self, name: str) -> None: ...
    async def set_camera(self, name: str, camera: Mapping[str, float]) -> Mapping[str, float]:
        """Set the stream's virtual camera and return its resulting position."""


class EncodedPicture(Protocol):
    """Encoded picture, shared by all viewers."""

    @property
    def message(self) -> bytes:
        """Return the picture as one WebSocket message: header length (4 bytes, big-endian), JSON
        header, JPEG."""

    @property
    def part(self) -> bytes:
        """Return the picture as a part of a multipart answer with the boundary `BOUNDARY`."""


class Display(Protocol):
    """Source of stream pictures. Slow subscribers skip pictures and get the newest."""

    def subscribe(
        self, stream: str, kind: PictureKind, quality: int
    ) -> AbstractAsyncContextManager[AsyncIterator[EncodedPicture]]:
        """Subscribe to a stream. The iterator ends when the stream is deleted.

        Args:
            stream: name of the stream.
            kind: picture to receive.
            quality: JPEG quality.
        """


@dataclass(frozen=True)
class CheckResult:
    """Health of a part. The service is ready if all needed parts are ok, and degraded if another
    part is not."""

    ok: bool
    detail: str = ""
    needed: bool = True


@dataclass(frozen=True)
class Parts:
    """Parts of a server. Requests for an absent part are answered with 503."""

    streams: Streams | None = None
    models: Models | None = None
    display: Display | None = None
    jobs: Jobs | None = None
    recordings: Recordings | None = None
    snapshots: Snapshots | None = None
    exports: Exports | None = None
    routers: Sequence[APIRouter] = ()
    """Further routers, created by `new_router`."""
    background: Sequence[Callable[[], AbstractAsyncContextManager[Any]]] = ()
    """Context managers entered in order at server start and left in reverse order after the drain.
    """
    checks: Mapping[str, Callable[[], Awaitable[CheckResult]]] = field(default_factory=dict)
    """Health checks for /readyz, by name."""
    collectors: Sequence[Collector] = ()
    """Metric collectors for /metrics."""
    events: SystemEvents = field(default_factory=SystemEvents)
    """Events of the parts for the audit log, not caused by a request."""
    trusts_ages: Callable[[], bool] = lambda: True
    """Return True if old audit segments may be deleted by age now."""
    errors: Mapping[type[Exception], type[Problem]] = field(default_factory=dict)
    """Problem type for each error type of the parts; the error text is sent to the caller."""
