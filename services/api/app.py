"""Application of a server: its components from the settings, and the routes, access guards and limits around them."""

from __future__ import annotations

import asyncio
import logging
import os
import re
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import APIRouter, FastAPI
from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from services import product_version
from services.api import audit as audit_routes
from services.api import display, models, pages, recordings, replays, service, snapshots, streams
from services.api import keys as key_routes
from services.api.guard import AddressRate, HeadLength, KnownHosts, Observed, SecurityHeaders, operation_id
from services.api.observability import Measures, StreamMeasures
from services.api.pages import ABOUT, describe
from services.api.problems import Conflicting, Missing, Problem, Unavailable, Unprocessable, answer_with_problems
from services.api.state import ControlState, Parts, Storage, TokenBuckets, ViewerCount, folders_of
from services.audit import AuditLog, AuditUnwritable, Keeping
from services.audit.log import AUDIT_FILE, Outcome, SystemEvents
from services.auth.keys import KEYS_FILE, KeyStore, Tickets, changed_outside, first_admin_key, keys_read_again
from services.backup import StoredFiles, StoredFilesWatch
from services.bus.runtime import RuntimeFolder
from services.errors import (
    BusError,
    Conflict,
    ExportBusy,
    ExportFailed,
    ExportRefused,
    NoSnapshot,
    NotFound,
    Rejected,
    SettingsInvalid,
    StoreUnavailable,
)
from services.exports.files import ExportCache
from services.exports.snapshots import ModelExports, SnapshotStore, StreamSnapshots
from services.jobs.pool import PoolKeeper, PoolProcess, PoolSettings
from services.jobs.results import Replays, Results
from services.jobs.store import JobStore, uses_recording
from services.recordings.store import RecordingStore, State
from services.registry.models import DATABASE_FILE, ModelRegistry
from services.registry.records import NICENESS
from services.retention import ClockGuard, RecordingRetention, ReplayRetention
from services.schemas import CheckResult
from services.settings import ServiceSettings
from services.supervisor.process import StreamEvent
from services.supervisor.stream import ShownModels, SupervisedStreams

if TYPE_CHECKING:
    from services.auth.oidc import OpenIdPersons

log = logging.getLogger(__name__)
ROUTERS: tuple[APIRouter, ...] = (
    service.router, service.service_router, streams.router, display.router, models.router, snapshots.router, snapshots.exports_router, replays.router,
    recordings.router, key_routes.router, audit_routes.router, pages.router,
)  # fmt: skip


def new_app(settings: ServiceSettings, parts: Parts | None = None) -> FastAPI:
    """Build the control plane as an ASGI application.

    Creates `settings.data_dir` and its stores. On the first start, writes the administrator's key
    to `settings.admin_key_file`.

    Raises:
        AuditError: if another server uses the same data folder.
        SettingsInvalid: if `auth.oidc` is set and PyJWT is not installed.
    """
    parts = parts or Parts()
    control = _new_state(settings, parts)
    app = FastAPI(
        title="IntraSplat",
        version=product_version(),
        summary="Live, deforming 3D reconstruction from endoscopic video.",
        description=ABOUT,
        openapi_url=None, docs_url=None, redoc_url=None,  # `pages.py` serves them, without external resources
        redirect_slashes=False,
        generate_unique_id_function=operation_id,
        lifespan=_lifespan,
    )  # fmt: skip
    app.state.control = control
    for router in ROUTERS:
        app.router.routes += router.routes  # `include_router` would build each of them again at the first request
    for router in parts.routers:
        app.include_router(router)
    answer_with_problems(app, parts.errors)
    describe(app)
    limits = settings.limits
    by_address = TokenBuckets(limits.address_requests_per_s, limits.address_requests_per_s * limits.burst_s)
    # Each middleware wraps the ones added before it.
    app.add_middleware(KnownHosts, server=settings.server, measures=control.measures)
    app.add_middleware(AddressRate, buckets=by_address, measures=control.measures)
    app.add_middleware(HeadLength, measures=control.measures)
    app.add_middleware(Observed, measures=control.measures)
    app.add_middleware(SecurityHeaders)
    if settings.server.trusted_proxies:
        app.add_middleware(ProxyHeadersMiddleware, trusted_hosts=list(settings.server.trusted_proxies))
    return app


def _new_state(settings: ServiceSettings, parts: Parts) -> ControlState:
    persons = _persons(settings)
    data = settings.data_dir
    uploads = data / "uploads"
    for folder in (data, uploads):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    keep = settings.audit
    # The audit log is opened before the stores, because its lock excludes other servers from these folders.
    audit = AuditLog(
        data / AUDIT_FILE, Keeping(keep.segment_bytes, keep.keep_segments, keep.keep_days, parts.trusts_ages)
    )
    _remove_unfinished(uploads)
    keys = KeyStore(data / KEYS_FILE)
    made = first_admin_key(keys, settings.admin_key_file)
    if made:
        audit.append("key.create", actor="system", subject="admin", detail={"role": "admin", "first": True})
        log.warning("the administrator's key was made: it is in %s", settings.admin_key_file)
    keys.watch(partial(changed_outside, audit))
    limits = settings.limits
    storage = Storage(folders_of(settings), audit)
    return ControlState(
        settings=settings,
        parts=parts,
        keys=keys,
        tickets=Tickets(settings.auth.ticket_s),
        audit=audit,
        measures=Measures([*parts.collectors, storage], lambda: audit.head.seq + 1),
        key_rate=TokenBuckets(limits.requests_per_s, limits.requests_per_s * limits.burst_s),
        uploads_dir=uploads,
        uploads=asyncio.Semaphore(limits.uploads),
        viewers=ViewerCount(limits.viewers),
        storage=storage,
        persons=persons,
    )


def _persons(settings: ServiceSettings) -> OpenIdPersons | None:
    if settings.auth.oidc is None:
        return None
    try:
        from services.auth.oidc import OpenIdPersons
    except ModuleNotFoundError as error:
        raise SettingsInvalid("auth.oidc needs PyJWT; install intrasplat with the extra oidc") from error
    return OpenIdPersons(settings.auth.oidc)


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    control: ControlState = app.state.control
    async with AsyncExitStack() as running:
        await running.enter_async_context(control.parts.events.written_to(control.audit))
        await running.enter_async_context(keys_read_again(control.keys))
        for enter in control.parts.background:
            await running.enter_async_context(enter())
        audit = control.audit
        await asyncio.to_thread(audit.append, "service.start", actor="system", detail={"version": product_version()})
        try:
            yield
        finally:
            control.draining.set()
            if control.tasks:
                await asyncio.wait(control.tasks, timeout=control.settings.server.drain_s)
            try:
                await asyncio.to_thread(audit.append, "service.stop", actor="system")
            except AuditUnwritable as error:
                log.error("the end of the service is not in the audit log: %s", error)
    control.audit.close()


def _remove_unfinished(uploads: Path) -> None:
    """Delete partial uploads of a killed server."""
    for name in os.listdir(uploads):
        if name.startswith("upload-"):
            (uploads / name).unlink()


@dataclass(frozen=True)
class Archive:
    """Components of a server for recordings and replay jobs: stores, retention tasks, job pool, metrics and the check for missing files."""

    recordings: RecordingStore
    recording_retention: RecordingRetention
    replays: Replays
    replay_retention: ReplayRetention
    pool: PoolKeeper
    measures: ArchiveMeasures
    files: StoredFilesWatch


def new_archive(
    settings: ServiceSettings, events: SystemEvents, trusts_ages: Callable[[], bool] = lambda: True
) -> Archive:
    """Create the components for recordings and replays. The registry must already have created the database folder.

    Args:
        settings: settings of the service.
        events: receives events for the audit log.
        trusts_ages: returns True while the clock is trusted, so that data may be deleted by age.

    Raises:
        StoreUnavailable: if the database or the folders cannot be used.
    """
    data, wanted, jobs, folders = settings.data_dir, settings.uploaded_recordings, settings.jobs, folders_of(settings)
    database = settings.registry.database
    url = (
        f"sqlite:///{(data / 'registry' / DATABASE_FILE).absolute()}"
        if database is None
        else database.get_secret_value()
    )
    recordings = RecordingStore(
        folders["recordings"],
        url,
        most_unpacked_bytes=wanted.unpacked_bytes,
        in_use=uses_recording,
    )
    store = JobStore(url, recordings.path_of)
    results = Results(folders["replays"].absolute())
    threads = jobs.threads or max(1, (os.cpu_count() or 1) // (2 * jobs.workers))
    pool = PoolSettings(jobs.workers, threads, jobs.lease_s, jobs.attempts, NICENESS, pack_models=True)
    process = PoolProcess(url, str(results.folder), pool, jobs.ray)
    replays = Replays(store, results)
    return Archive(
        recordings,
        RecordingRetention(recordings, wanted.keep_days, wanted.keep_bytes, events, trusts_ages),
        replays,
        ReplayRetention(replays, jobs.keep_days, jobs.keep_results, events, trusts_ages),
        PoolKeeper(process, store.open_jobs),
        ArchiveMeasures(recordings, store),
        StoredFilesWatch(
            store.database,
            StoredFiles(
                recordings.folder, results.folder, None if settings.registry.blobs else data / "registry" / "blobs"
            ),
            events,
        ),
    )


class ArchiveMeasures(Collector):
    """Prometheus collector for recordings and replays: counts by state, without names."""

    def __init__(self, recordings: RecordingStore, store: JobStore) -> None:
        self._recordings, self._store = recordings, store

    def collect(self) -> Iterable[Metric]:
        """Export the counts at scrape time (none if the database is unavailable); see `Collector`."""
        replays = GaugeMetricFamily("intrasplat_replays", "Replays in each state.", labels=["state"])
        recordings = GaugeMetricFamily("intrasplat_recordings", "Uploaded recordings in each state.", labels=["state"])
        kept = GaugeMetricFamily("intrasplat_recordings_bytes", "What uploaded recordings take on the disk.")
        try:
            for state, count in self._store.counts().items():
                replays.add_metric([state], count)
            found = self._recordings.all()
            for each in State:
                recordings.add_metric([str(each)], sum(record.state is each for record in found))
            kept.add_metric([], sum(record.kept_bytes for record in found))
        except StoreUnavailable as error:
            log.warning("%s", error)
        return [replays, recordings, kept]


OWN_WORDS = re.compile(
    r"killed by SIG[A-Z0-9]+|exit code -?\d+|again|for the first time|the server ends"
    r"|its? [a-z]+( [a-z]+)*( \d+(\.\d+)? s)?(; it was killed)?"
)
ERRORS: dict[type[Exception], type[Problem]] = {
    NotFound: Missing,
    Conflict: Conflicting,
    Rejected: Unprocessable,
    StoreUnavailable: Unavailable,
    BusError: Unavailable,
    NoSnapshot: Missing,
    ExportRefused: Unprocessable,
    ExportBusy: Unavailable,
    ExportFailed: Unavailable,
}


def assembled(settings: ServiceSettings) -> Parts:
    """Create all components of the control plane.

    Raises:
        RuntimeFolderUnusable: if the runtime folder cannot be used.
        StoreUnavailable: if the database or the files cannot be used.
    """
    measures = StreamMeasures()
    events = SystemEvents()
    streams = SupervisedStreams(
        RuntimeFolder(settings.runtime_dir),
        event_receiver(measures, events),
        settings.limits.streams,
        settings.server.takeover_s,
        mps=settings.gpu.mps,
    )
    measures.streams = streams
    models = registry_of(settings)
    snapshots = SnapshotStore(settings.data_dir / "snapshots")
    exports = ModelExports(models, snapshots, ExportCache(settings.data_dir / "exports"))
    clock = ClockGuard(settings.data_dir)
    archive = new_archive(settings, events, clock.trusts_ages)

    async def streams_are_well() -> CheckResult:
        unwell = [stream for stream in streams.all() if stream.state in ("failed", "source lost")]
        # The reasons are left out, because /readyz can be read without a key.
        said = "; ".join(f"{stream.name}: {stream.state}" for stream in unwell)
        return CheckResult(not unwell, said or "no stream has failed or lost its source", needed=False)

    async def clock_is_right() -> CheckResult:
        doubt = await asyncio.to_thread(lambda: clock.doubt)
        return CheckResult(doubt is None, doubt or "no jump detected", needed=False)

    async def models_are_there() -> CheckResult:
        try:
            known = await asyncio.to_thread(models.models)
        except StoreUnavailable as error:
            return CheckResult(False, str(error))
        return CheckResult(True, f"{len(known)} models")

    return Parts(
        streams=streams,
        models=models,
        display=streams,
        snapshots=StreamSnapshots(streams, models, snapshots),
        exports=exports,
        jobs=archive.replays,
        recordings=archive.recordings,
        routers=[pages.console_router],
        background=[
            lambda: recovered(models, events),
            exports.running,
            lambda: streams.running(settings.streams),
            ShownModels(streams, models, events).following,
            archive.recording_retention.running,
            archive.files.running,
            archive.replay_retention.running,
            archive.pool.running,
        ],
        checks={
            "streams": streams_are_well,
            "models": models_are_there,
            "files": archive.files.check,
            "clock": clock_is_right,
        },
        collectors=[measures, archive.measures, archive.files],
        events=events,
        trusts_ages=clock.trusts_ages,
        errors=ERRORS,
    )


def event_receiver(measures: StreamMeasures, events: SystemEvents) -> Callable[[StreamEvent], None]:
    """Return the receiver of process events, for metrics and audit log.

    The audit log records a reason only if its text is composed by the supervisor. A text from the stream process could
    contain a file name that identifies a patient.
    """

    def tell(event: StreamEvent) -> None:
        measures.count(event)
        reason = event.reason if OWN_WORDS.fullmatch(event.reason) else "the log has the reason"
        outcome: Outcome = "failed" if event.kind in ("ended", "lost") else "done"
        if event.kind in ("lost", "recovered"):
            events.tell(f"source.{event.kind}", event.stream, outcome, reason=reason)
            return
        events.tell(f"process.{event.kind}", f"{event.stream}/{event.role}", outcome, pid=event.pid, reason=reason)

    return tell


def registry_of(settings: ServiceSettings) -> ModelRegistry:
    """Open the registry in the service's folder or as configured.

    Raises:
        StoreUnavailable: if it cannot be opened.
    """
    wanted = settings.registry
    options = {name: value.get_secret_value() for name, value in wanted.blob_options.items()}
    return ModelRegistry(
        settings.data_dir / "registry",
        database_url=None if wanted.database is None else wanted.database.get_secret_value(),
        blobs_url=wanted.blobs,
        blob_options=options or None,
        most_upload_bytes=settings.limits.model_bytes,
    )


@asynccontextmanager
async def recovered(models: ModelRegistry, events: SystemEvents) -> AsyncIterator[None]:
    """Recover the registry at start: delete leftovers, report damage and run pending checks. Close
    the registry at the end of the block."""
    found = await asyncio.to_thread(models.recover)
    for name, version, sentence in found.damaged:
        log.error("the file of %s/%d is damaged: %s", name, version, sentence)
    if found.removed or found.skipped:
        log.warning(
            "the registry: %d leftovers removed; %s", len(found.removed), found.skipped or "nothing was skipped"
        )

    async def check_waiting() -> None:
        for name, version in found.unchecked:
            try:
                record = await asyncio.to_thread(models.check, name, version)
                events.tell("model.check", f"{name}/{version}", "refused" if record.state == "rejected" else "done")
            except (NotFound, StoreUnavailable) as error:
                log.error("%s/%d was not checked: %s", name, version, error)

    checking = asyncio.create_task(check_waiting(), name="checks of waiting models")
    try:
        yield
    finally:
        checking.cancel()
        await asyncio.gather(checking, return_exceptions=True)
        await asyncio.to_thread(models.close)
