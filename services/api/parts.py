"""Protocols of the parts of a server. Each part can be built, tested and omitted separately.

Synchronous parts are thread-safe; the API calls them in worker threads. `Parts.errors` maps their errors to problems.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal, Protocol

from fastapi import APIRouter
from prometheus_client.registry import Collector

from gsplat_core.io.exports.formats import ExportWish
from services.api.problems import Problem
from services.audit.system_events import SystemEvents


class RecordingRecord(Protocol):
    """Record of an uploaded recording."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def state(self) -> str: ...
    @property
    def reason(self) -> str | None: ...
    @property
    def digest(self) -> str: ...
    @property
    def size_bytes(self) -> int: ...
    @property
    def kept_bytes(self) -> int: ...
    @property
    def uploaded_at(self) -> Any: ...
    @property
    def uploaded_by(self) -> str: ...
    @property
    def description(self) -> Mapping[str, Any]: ...


class Recordings(Protocol):
    """Store of uploaded recordings."""

    def add(self, name: str, file: Path, digest: str, by: str) -> tuple[RecordingRecord, bool]:
        """Move a file into the store.

        Args:
            name: name of the recording.
            file: path of the upload.
            digest: its SHA-256 in hex.
            by: the caller, for the record.

        Returns:
            The record, and False if the same file is already stored under this name.
        """
        ...

    def check(self, name: str) -> RecordingRecord:
        """Validate a recording and mark it ready, or rejected with a reason."""
        ...

    def all(self) -> Sequence[RecordingRecord]: ...
    def get(self, name: str) -> RecordingRecord: ...
    def delete(self, name: str) -> RecordingRecord: ...


class JobRecord(Protocol):
    """Record of a replay job."""

    @property
    def id(self) -> str: ...
    @property
    def number(self) -> int: ...
    @property
    def batch(self) -> str: ...
    @property
    def recording(self) -> str: ...
    @property
    def folder(self) -> str: ...
    @property
    def options(self) -> Mapping[str, Any]: ...
    @property
    def state(self) -> str: ...
    @property
    def reason(self) -> str | None: ...
    @property
    def is_open(self) -> bool: ...


class Submission(Protocol):
    """Result of a submission: one job per recording."""

    @property
    def batch(self) -> str: ...
    @property
    def ids(self) -> Sequence[str]: ...
    @property
    def is_new(self) -> bool: ...


class Jobs(Protocol):
    """Queue of replay jobs."""

    def submit(
        self, recordings: Sequence[str], options: Mapping[str, Any], by: str, idempotency_key: str | None
    ) -> Submission: ...

    def newest(
        self, count: int, *, before: int | None, batch: str | None, state: str | None
    ) -> Sequence[JobRecord]: ...

    def get(self, job_id: str) -> JobRecord: ...
    def counts(self, batch: str | None = None) -> Mapping[str, int]: ...
    def cancel(self, job_id: str, by: str) -> JobRecord: ...
    def delete(self, job_id: str) -> JobRecord:
        """Delete a finished replay and its results."""
        ...

    def files(self, job: JobRecord) -> Sequence[str]:
        """Return the names of the result files."""
        ...

    def file(self, job_id: str, name: str) -> Path:
        """Return the path of a result file."""
        ...


class ExportedFile(Protocol):
    """Exported file, open for reading. The caller closes it."""

    @property
    def file(self) -> BinaryIO: ...
    @property
    def sha256(self) -> str: ...
    @property
    def size_bytes(self) -> int: ...


class Snapshots(Protocol):
    """Snapshots of live streams. `Parts.errors` names their errors."""

    async def take(self, stream: str, model: str | None, by: str) -> tuple[Any, Any]:
        """Write the current live model of a stream.

        Args:
            stream: name of the stream.
            model: if given, the snapshot becomes the next version of this model, still to be
                checked. Otherwise it is stored as a file.
            by: the caller, for the record.

        Returns:
            The snapshot's record, and the version record or None.
        """

    def all(self, stream: str) -> Sequence[Any]:
        """Return the stored snapshots of a stream, newest first. Synchronous, like the methods
        below."""

    def get(self, stream: str, number: str) -> Any: ...
    def delete(self, stream: str, number: str) -> None: ...


class Exports(Protocol):
    """Exporter of models and snapshots to files. Synchronous and thread-safe; a separate process
    creates missing exports."""

    def of_version(self, name: str, number: int, wish: ExportWish) -> ExportedFile: ...
    def of_snapshot(self, stream: str, number: str, wish: ExportWish) -> ExportedFile: ...


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
