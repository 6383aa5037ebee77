"""Snapshots of live streams, and exports of snapshots and registry models."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.exports.formats import ExportWish
from services.control.problems import Conflicting, Unprocessable
from services.errors import CommandRefused
from services.exports.cache import ExportCache, Exported
from services.exports.snapshots import Snapshot, SnapshotStore, described
from services.registry.bundle_file import SUFFIX, pack
from services.registry.models import ModelRegistry
from services.registry.records import State, VersionRecord
from services.server.streams import SupervisedStreams

WRITE_S = 60.0
"""Seconds that an engine may take to write its model."""
CHECKED = (State.READY, State.ACTIVE, State.RETIRED)


class StreamSnapshots:
    """Implementation of `services.control.snapshot_parts.Snapshots`."""

    def __init__(self, streams: SupervisedStreams, registry: ModelRegistry, store: SnapshotStore) -> None:
        self._streams, self._registry, self._store = streams, registry, store

    async def take(self, stream: str, model: str | None, by: str) -> tuple[Snapshot, VersionRecord | None]:
        """See `Snapshots`.

        Raises:
            Missing: if the stream does not exist.
            Conflicting: if the stream is stopped or just starting.
            BusError: if the engine does not answer.
            ExportFailed: if the snapshot cannot be stored.
            RegistryError: if the registry does not take it.
        """
        supervisor = self._streams.with_engine(stream)
        with self._store.new() as new:
            folder = new / "model"
            try:
                said = await supervisor.command("engine", "snapshot", timeout_s=WRITE_S, folder=str(folder))
            except CommandRefused as error:
                raise Conflicting(str(error)) from error
            taken = await asyncio.to_thread(described, folder, stream, by, said)
            if model is None:
                await asyncio.to_thread(self._store.keep, folder, taken)
                return taken, None
            packed = new / f"model{SUFFIX}"
            await asyncio.to_thread(pack, folder, packed)
            return taken, await asyncio.to_thread(self._registry.upload, model, packed, None, by)

    def all(self, stream: str) -> Sequence[Snapshot]:
        """See `Snapshots`."""
        return self._store.all(stream)

    def get(self, stream: str, number: str) -> Snapshot:
        """See `Snapshots`. Raises NoSnapshot."""
        return self._store.get(stream, number)

    def delete(self, stream: str, number: str) -> None:
        """See `Snapshots`. Raises NoSnapshot."""
        self._store.delete(stream, number)


def refuse_outside(wish: ExportWish, window_s: Sequence[float]) -> None:
    """Refuse times outside the model's window before an export process is started.

    Raises:
        Unprocessable: if a time is outside.
    """
    start_s, end_s = window_s
    try:
        wish.times_in((start_s, end_s))
    except InvalidSetting as error:
        raise Unprocessable(str(error)) from error


class ModelExports:
    """Implementation of `services.control.snapshot_parts.Exports`."""

    def __init__(self, registry: ModelRegistry, store: SnapshotStore, cache: ExportCache) -> None:
        self._registry, self._store, self._cache = registry, store, cache

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Abort running exports at the end of the block."""
        try:
            yield
        finally:
            await asyncio.to_thread(self._cache.close)

    def of_version(self, name: str, number: int, wish: ExportWish) -> Exported:
        """See `Exports`.

        Raises:
            RegistryError: if the version does not exist.
            ExportsError: if the export fails.
            Conflicting: if the version was not checked.
        """
        version: Any = self._registry.version(name, number)
        if version.state not in CHECKED:
            raise Conflicting(f"{name}/{number} is {version.state}; only a version that passed its check is exported")
        refuse_outside(wish, version.description["time_window_s"])
        return self._cache.get(version.digest, lambda: self._registry.folder_of(name, number), wish)

    def of_snapshot(self, stream: str, number: str, wish: ExportWish) -> Exported:
        """See `Exports`. Raises NoSnapshot, ExportsError."""
        snapshot = self._store.get(stream, number)
        refuse_outside(wish, snapshot.time_window_s)
        return self._cache.get(snapshot.digest, lambda: self._store.folder_of(stream, number), wish)
