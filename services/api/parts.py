"""Parts of a server. Each part can be built, tested and omitted separately.

The registry, recordings, replays and exports are synchronous and thread-safe; the API calls them in worker threads. `Parts.errors` maps their errors to
problems.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from fastapi import APIRouter
from prometheus_client.registry import Collector

from services.api.problems import Problem
from services.audit.system_events import SystemEvents

if TYPE_CHECKING:
    from services.exports.snapshots import ModelExports, StreamSnapshots
    from services.jobs.replays import Replays
    from services.recordings.store import RecordingStore
    from services.registry.models import ModelRegistry
    from services.supervisor.stream import StreamDisplays, SupervisedStreams


PictureKind = Literal["raw", "shown", "depth", "confidence", "orbit"]


@dataclass(frozen=True)
class NewStream:
    """Stream requested by a caller; the source already passed the source rules."""

    name: str
    source: str
    show: str
    device: str
    options: Mapping[str, Any]


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

    streams: SupervisedStreams | None = None
    models: ModelRegistry | None = None
    display: StreamDisplays | None = None
    jobs: Replays | None = None
    recordings: RecordingStore | None = None
    snapshots: StreamSnapshots | None = None
    exports: ModelExports | None = None
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
