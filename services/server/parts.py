"""The parts of a server, as its settings want them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from services.bus.errors import BusError
from services.bus.runtime import RuntimeFolder
from services.control.parts import CheckResult, NewStream, Parts
from services.control.problems import Conflicting, Missing, Problem, Unavailable, Unprocessable
from services.exports.cache import ExportCache
from services.exports.errors import ExportBusy, ExportFailed, ExportRefused, NoSnapshot
from services.exports.snapshots import SnapshotStore
from services.registry.errors import Conflict, NotFound, Rejected, StoreUnavailable
from services.registry.limits import RegistryLimits
from services.registry.models import ModelRegistry
from services.server import page
from services.server.displays import StreamDisplays
from services.server.measures import StreamMeasures
from services.server.shown_models import ShownModels
from services.server.snapshots import ModelExports, StreamSnapshots
from services.server.streams import SupervisedStreams
from services.settings import ServiceSettings

log = logging.getLogger(__name__)
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
    """Everything that the control plane serves. Raises RuntimeFolderUnusable, StoreUnavailable."""
    measures = StreamMeasures()
    streams = SupervisedStreams(RuntimeFolder(settings.runtime_dir), measures.count)
    measures.streams = streams
    models = registry_of(settings)
    snapshots = SnapshotStore(settings.data_dir / "snapshots")
    exports = ModelExports(models, snapshots, ExportCache(settings.data_dir / "exports"))
    at_start = [
        NewStream(name, stream.source, stream.show, stream.device, stream.options)
        for name, stream in settings.streams.items()
    ]
    started = [name for name, stream in settings.streams.items() if stream.start]

    async def streams_are_well() -> CheckResult:
        failed = [stream for stream in streams.now() if stream.state == "failed"]
        said = "; ".join(f"{stream.name}: {stream.reason}" for stream in failed)
        return CheckResult(not failed, said or "no stream has failed", needed=False)

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
        routers=[page.router],
        background=[
            lambda: recovered(models),
            exports.running,
            lambda: streams.running(at_start, started),
            ShownModels(streams, models).following,
        ],
        checks={"streams": streams_are_well, "models": models_are_there},
        collectors=[measures],
        errors=ERRORS,
    )


def registry_of(settings: ServiceSettings) -> ModelRegistry:
    """The registry in the service's folder, or where the settings say. Raises StoreUnavailable."""
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
async def recovered(models: ModelRegistry) -> AsyncIterator[None]:
    """Clear away what a server that died had half written, say what else is wrong, and check what waits to be checked; close it in the end."""
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
                await asyncio.to_thread(models.check, name, version)
            except (NotFound, StoreUnavailable) as error:
                log.error("%s/%d was not checked: %s", name, version, error)

    checking = asyncio.create_task(check_waiting(), name="checks of waiting models")
    try:
        yield
    finally:
        checking.cancel()
        await asyncio.gather(checking, return_exceptions=True)
        await asyncio.to_thread(models.close)
