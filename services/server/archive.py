"""Recording store and replay jobs of a server. Both use the registry's database, so a recording in
use cannot be deleted."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from prometheus_client import Metric
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from services.audit.system_events import SystemEvents
from services.errors import StoreUnavailable
from services.jobs.pool import PoolProcess, PoolSettings
from services.jobs.pool_keeper import PoolKeeper
from services.jobs.replays import RecordingRetention, ReplayRetention, Replays
from services.jobs.results import Results
from services.jobs.store import JobStore, uses_recording
from services.missing_files import StoredFiles, StoredFilesWatch
from services.recordings.archives import RecordingLimits
from services.recordings.store import RecordingStore, State
from services.registry.limits import NICENESS
from services.registry.models import DATABASE_FILE
from services.settings import ServiceSettings

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Archive:
    """Recording and replay parts of a server."""

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
    """Create the parts from the settings. The registry must already have created the database
    folder.

    Args:
        settings: settings of the service.
        events: receives events for the audit log.
        trusts_ages: returns True if data may be deleted by age now.

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
        limits=RecordingLimits(unpacked_bytes=wanted.unpacked_bytes, entry_bytes=wanted.unpacked_bytes),
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
        """See `Collector`."""
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
