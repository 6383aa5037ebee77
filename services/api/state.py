"""State shared by the routes of one application: components, stores, open displays, cached answers, and checks of disk
and audit log.

The registry, recordings, replays and exports are synchronous and thread-safe; routes call them in worker threads.
`Parts.errors` maps their exceptions to problem answers.
"""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import time
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from fastapi import APIRouter, Header
from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from starlette.requests import HTTPConnection

from services.api.observability import Measures
from services.api.problems import Missing, NotBuiltIn, Problem, Unprocessable
from services.audit import AuditError, AuditLog
from services.audit.log import SystemEvents
from services.auth.keys import KeyStore, Tickets
from services.schemas import CheckResult
from services.settings import ServiceSettings

if TYPE_CHECKING:
    from services.auth.oidc import OpenIdPersons
    from services.exports.snapshots import ModelExports, StreamSnapshots
    from services.jobs.results import Replays
    from services.recordings.store import RecordingStore
    from services.registry.models import ModelRegistry
    from services.supervisor.stream import SupervisedStreams


@dataclass(frozen=True)
class Parts:
    """Components of a server. A request that needs an absent component is answered with 503."""

    streams: SupervisedStreams | None = None
    models: ModelRegistry | None = None
    display: SupervisedStreams | None = None
    jobs: Replays | None = None
    recordings: RecordingStore | None = None
    snapshots: StreamSnapshots | None = None
    exports: ModelExports | None = None
    routers: Sequence[APIRouter] = ()
    """Further routers, created by `new_router`."""
    background: Sequence[Callable[[], AbstractAsyncContextManager[Any]]] = ()
    """Context managers entered in order at server start and left in reverse order after the drain."""
    checks: Mapping[str, Callable[[], Awaitable[CheckResult]]] = field(default_factory=dict)
    """Health checks for /readyz, by name."""
    collectors: Sequence[Collector] = ()
    """Metric collectors for /metrics."""
    events: SystemEvents = field(default_factory=SystemEvents)
    """Queue of audit events that no request causes, such as ended processes."""
    trusts_ages: Callable[[], bool] = lambda: True
    """Returns True while the clock is trusted, so that old audit segments may be deleted by age."""
    errors: Mapping[type[Exception], type[Problem]] = field(default_factory=dict)
    """Problem type for each exception type of the components. The exception's message is sent to the caller."""


class ViewerCount:
    """Counter of open displays with an upper limit."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._open = 0

    @property
    def full(self) -> bool:
        """Return True if as many displays are open as allowed."""
        return self._open >= self._most

    @contextmanager
    def one_more(self) -> Iterator[None]:
        """Count one open display while the block runs."""
        self._open += 1
        try:
            yield
        finally:
            self._open -= 1


MOST_BUCKETS = 20_000


class TokenBuckets:
    """Token bucket per caller: `rate_per_s` tokens are added per second, at most `burst` are kept."""

    def __init__(self, rate_per_s: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate_per_s
        self._burst = max(1.0, burst)
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, caller: str, tokens: float = 1.0) -> float:
        """Take tokens from a caller's bucket.

        Returns:
            0 if there were enough tokens; otherwise the seconds until there are, and none is taken.
        """
        now_s = self._clock()
        left, at_s = self._buckets.pop(caller, (self._burst, now_s))
        left = min(self._burst, left + (now_s - at_s) * self._rate)
        enough = left >= tokens
        self._buckets[caller] = (left - tokens if enough else left, now_s)
        if len(self._buckets) > MOST_BUCKETS:
            self._buckets.popitem(last=False)  # least recently used: this bucket has refilled, or nearly
        return 0.0 if enough else (tokens - left) / self._rate


IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=200,
        description="Text chosen by the caller. A repeated request with the same text gets the first answer again, until the "
        "server restarts.",
        examples=["9f1c2a6e-take-7"],
    ),
]
MOST_KEPT = 1000


class Repeated:
    """Cache of recent answers by caller and idempotency key. For use in one event loop."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[str, str], tuple[str, asyncio.Task[Any]]] = OrderedDict()

    async def once(self, caller: str, key: str | None, asked: str, act: Callable[[], Awaitable[Any]]) -> Any:
        """Run `act` once per caller and key; later calls return the first result. Failed runs are not cached.

        Args:
            caller: key id of the caller.
            key: the Idempotency-Key; without it `act` always runs.
            asked: fingerprint of the request.
            act: performs the request.

        Raises:
            Unprocessable: if the key was used for a different request.
        """
        if key is None:
            return await act()
        known = self._kept.get((caller, key))
        if known is not None and known[0] != asked:
            raise Unprocessable("this Idempotency-Key was used for another request; take a new one")
        if known is None or (known[1].done() and (known[1].cancelled() or known[1].exception() is not None)):
            known = asked, asyncio.ensure_future(_awaited(act))
            self._kept[caller, key] = known
            while len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
        return await asyncio.shield(known[1])


async def _awaited(act: Callable[[], Awaitable[Any]]) -> Any:
    return await act()


log = logging.getLogger(__name__)
KEYS_UNREADABLE = "the file of the API keys cannot be read, so no key is accepted; the log of the server has the cause"
SPARE_BYTES = 256 * 2**20
"""Free bytes that uploads leave for the audit log and the database. With less the service is degraded."""


def folders_of(settings: ServiceSettings) -> dict[str, Path]:
    """Return the data folders of the service, by name."""
    data = settings.data_dir
    return {
        "data": data,
        "recordings": settings.uploaded_recordings.folder or data / "recordings",
        "replays": settings.jobs.folder or data / "replays",
    }


class Storage(Collector):
    """Disks under the service's folders, and the writability of the audit log."""

    def __init__(self, folders: Mapping[str, Path], audit: AuditLog) -> None:
        self._folders, self._audit = folders, audit

    def collect(self) -> Iterable[Metric]:
        """Export free space, disk size and audit writability; see `Collector`."""
        free = GaugeMetricFamily("intrasplat_disk_free_bytes", "Free space under a folder.", labels=["folder"])
        size = GaugeMetricFamily("intrasplat_disk_bytes", "Size of the disk under a folder.", labels=["folder"])
        for name, folder in self._folders.items():
            try:
                usage = shutil.disk_usage(_existing(folder))
            except OSError as error:
                log.warning("the free space of %s is not known: %s", folder, error)
                continue
            free.add_metric([name], usage.free)
            size.add_metric([name], usage.total)
        writable = GaugeMetricFamily(
            "intrasplat_audit_writable", "0 after an entry of the audit log could not be written."
        )
        writable.add_metric([], float(self._audit.failure is None))
        return [free, size, writable]

    async def disk(self) -> CheckResult:
        """Report free space per folder. Less than `SPARE_BYTES` makes the service degraded."""
        return await asyncio.to_thread(self._disk)

    async def audit(self) -> CheckResult:
        """Report the audit log's writability. After a failure, append a test entry to detect recovery."""
        if self._audit.failure is None:
            return CheckResult(True, "entries are written")
        try:
            await asyncio.to_thread(self._audit.append, "audit.writable", actor="system", subject="audit")
        except AuditError as error:
            return CheckResult(False, str(error))
        return CheckResult(True, "entries are written again")

    def _disk(self) -> CheckResult:
        said, ok = [], True
        for name, folder in self._folders.items():
            try:
                free = shutil.disk_usage(_existing(folder)).free
            except OSError as error:
                ok = False
                said.append(f"{name}: {error.strerror}")
                continue
            ok = ok and free >= SPARE_BYTES
            said.append(f"{name}: {free // 2**20} MiB free")
        return CheckResult(ok, "; ".join(said) + ("" if ok else "; free space on that disk"), needed=False)


def _existing(folder: Path) -> Path:
    """Return the folder, or its nearest existing ancestor."""
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    return folder


Part = TypeVar("Part")


@dataclass(frozen=True)
class ControlState:
    """Components, stores and limits of one application. Routes obtain it by `control_of`."""

    settings: ServiceSettings
    parts: Parts
    keys: KeyStore
    tickets: Tickets
    audit: AuditLog
    measures: Measures
    key_rate: TokenBuckets
    uploads_dir: Path
    uploads: asyncio.Semaphore
    viewers: ViewerCount
    storage: Storage
    persons: OpenIdPersons | None = None
    """OpenID Connect provider; None if the settings configure none."""
    uploads_of: Counter[str] = field(default_factory=Counter)
    """Number of running uploads by key id."""
    draining: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the server starts to drain; endless responses then end."""
    repeated: Repeated = field(default_factory=Repeated)
    """Cache of answers to requests with an Idempotency-Key."""
    audit_reads: TokenBuckets = field(default_factory=lambda: TokenBuckets(1 / 60, 1))
    """Limits audit entries about reading the audit log to one per key and filter each minute."""
    tasks: set[asyncio.Task[None]] = field(default_factory=set)
    """Background tasks that outlive their request."""


def control_of(connection: HTTPConnection) -> ControlState:
    """Return the state of the application that serves a connection."""
    state: ControlState = connection.app.state.control
    return state


def part(connection: HTTPConnection, choose: Callable[[Parts], Part | None], name: str) -> Part:
    """Return a component of this server.

    Args:
        connection: current request or WebSocket.
        choose: selects the component; returns None if it is absent.
        name: name of the component for the error message.

    Raises:
        NotBuiltIn: if the component is absent.
    """
    found = choose(control_of(connection).parts)
    if found is None:
        raise NotBuiltIn(f"this server was started without {name}")
    return found


def known_problem(control: ControlState, error: BaseException) -> type[Problem] | None:
    """Return the problem type for an exception of a component, or None for an unknown exception (a bug)."""
    known = control.parts.errors
    return next((known[each] for each in type(error).__mro__ if each in known), None)


async def is_missing(control: ControlState, look: Callable[[], object]) -> bool:
    """Return True if `look`, called in a worker thread, raises an exception that maps to the problem Missing."""
    try:
        await asyncio.to_thread(look)
    except Exception as error:
        if (kind := known_problem(control, error)) is None:
            raise
        return issubclass(kind, Missing)
    return False
