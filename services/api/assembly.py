"""Construction of a server's components (streams, models, recordings, replays, exports) from its settings."""

from __future__ import annotations

import asyncio
import logging
import os
import re
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from services.api import pages
from services.api.observability import StreamMeasures
from services.api.problems import Conflicting, Missing, Problem, Unavailable, Unprocessable
from services.api.state import Parts
from services.audit.files import Outcome
from services.audit.log import SystemEvents
from services.bus.runtime import RuntimeFolder
from services.clock_guard import ClockGuard
from services.errors import (
    BusError,
    Conflict,
    ExportBusy,
    ExportFailed,
    ExportRefused,
    NoSnapshot,
    NotFound,
    Rejected,
    StoreUnavailable,
)
from services.exports.cache import ExportCache
from services.exports.snapshots import ModelExports, SnapshotStore, StreamSnapshots
from services.jobs.pool import PoolKeeper, PoolProcess, PoolSettings
from services.jobs.replays import RecordingRetention, ReplayRetention, Replays
from services.jobs.results import Results
from services.jobs.store import JobStore, uses_recording
from services.missing_files import StoredFiles, StoredFilesWatch
from services.recordings.store import RecordingStore, State
from services.registry.models import DATABASE_FILE, ModelRegistry
from services.registry.records import NICENESS
from services.schemas import CheckResult
from services.settings import ServiceSettings
from services.supervisor.process import StreamEvent
from services.supervisor.stream import ShownModels, SupervisedStreams

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Archive:
    """Components of a server for recordings and replay jobs."""

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
    data, wanted, jobs = settings.data_dir, settings.uploaded_recordings, settings.jobs
    database = settings.registry.database
    url = (
        f"sqlite:///{(data / 'registry' / DATABASE_FILE).absolute()}"
        if database is None
        else database.get_secret_value()
    )
    recordings = RecordingStore(
        wanted.folder or data / "recordings",
        url,
        most_unpacked_bytes=wanted.unpacked_bytes,
        in_use=uses_recording,
    )
    store = JobStore(url, recordings.path_of)
    results = Results((jobs.folder or data / "replays").absolute())
    threads = jobs.threads or max(1, (os.cpu_count() or 1) // (2 * jobs.workers))
    pool = PoolSettings(jobs.workers, threads, jobs.lease_s, jobs.attempts, NICENESS, pack_models=True)
    process = PoolProcess(url, str(results.folder), pool, jobs.ray)
    replays = Replays(store, results)
    return Archive(
        recordings,
        RecordingRetention(recordings, wanted.keep_days, wanted.keep_bytes, events, trusts_ages),
        replays,
        ReplayRetention(replays, jobs.keep_days, jobs.keep_results, events, trusts_ages),
        PoolKeeper(process, lambda: _open(store.counts())),
        ArchiveMeasures(recordings, store),
        StoredFilesWatch(
            store.database,
            StoredFiles(
                recordings.folder, results.folder, None if settings.registry.blobs else data / "registry" / "blobs"
            ),
            events,
        ),
    )


def _open(counts: dict[str, int]) -> int:
    return counts["queued"] + counts["running"]


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
