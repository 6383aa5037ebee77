"""Assembly of a server's parts from its settings."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from services.audit.files import Outcome
from services.audit.system_events import SystemEvents
from services.bus.runtime import RuntimeFolder
from services.clock_guard import ClockGuard
from services.control.parts import CheckResult, NewStream, Parts
from services.control.problems import Conflicting, Missing, Problem, Unavailable, Unprocessable
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
from services.registry.limits import RegistryLimits
from services.registry.models import ModelRegistry
from services.server import page
from services.server.archive import new_archive
from services.settings import ServiceSettings
from services.supervisor.metrics import StreamMeasures
from services.supervisor.process import StreamEvent
from services.supervisor.stream import ShownModels, StreamDisplays, SupervisedStreams

log = logging.getLogger(__name__)
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
    """Create all parts of the control plane.

    Raises:
        RuntimeFolderUnusable: if the runtime folder cannot be used.
        StoreUnavailable: if the database or the files cannot be used.
    """
    measures = StreamMeasures()
    events = SystemEvents()
    streams = SupervisedStreams(RuntimeFolder(settings.runtime_dir), told(measures, events), settings.limits.streams)
    measures.streams = streams
    models = registry_of(settings)
    snapshots = SnapshotStore(settings.data_dir / "snapshots")
    exports = ModelExports(models, snapshots, ExportCache(settings.data_dir / "exports"))
    clock = ClockGuard(settings.data_dir)
    archive = new_archive(settings, events, clock.trusts_ages)
    at_start = [
        NewStream(name, stream.source, stream.show, stream.device, stream.options)
        for name, stream in settings.streams.items()
    ]
    started = [name for name, stream in settings.streams.items() if stream.start]

    async def streams_are_well() -> CheckResult:
        unwell = [stream for stream in streams.now() if stream.state in ("failed", "source lost")]
        # without reasons, because /readyz needs no key
        said = "; ".join(f"{stream.name}: {stream.state}" for stream in unwell)
        return CheckResult(not unwell, said or "no stream has failed or lost its source", needed=False)

    async def clock_is_right() -> CheckResult:
        doubt = await asyncio.to_thread(lambda: clock.doubt)
        return CheckResult(doubt is None, doubt or "it goes on evenly", needed=False)

    async def models_are_there() -> CheckResult:
        try:
            known = await asyncio.to_thread(models.models)
        except StoreUnavailable as error:
            return CheckResult(False, str(error))
        return CheckResult(True, f"{len(known)} models")

    return Parts(
        streams=streams,
        models=models,
        display=StreamDisplays(streams),
        snapshots=StreamSnapshots(streams, models, snapshots),
        exports=exports,
        jobs=archive.replays,
        recordings=archive.recordings,
        routers=[page.router],
        background=[
            lambda: recovered(models, events),
            exports.running,
            lambda: streams.running(at_start, started),
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


def told(measures: StreamMeasures, events: SystemEvents) -> Callable[[StreamEvent], None]:
    """Return the receiver of process events, for metrics and audit log.

    The audit log records a reason only if the supervisor worded it. Other texts could contain a
    file name that identifies a patient.
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
        limits=RegistryLimits(upload_bytes=settings.limits.model_bytes),
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
