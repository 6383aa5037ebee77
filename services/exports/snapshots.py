"""Snapshots of live streams, stored as files, and exports of snapshots and of registry models.

The newest snapshots of each stream are kept.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import os
import re
import secrets
import shutil
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.exports.formats import ExportWish
from gsplat_core.io.files import sync_folder, write_durably
from services.errors import CommandRefused, Conflict, ExportFailed, NoSnapshot, Rejected
from services.exports.files import ExportCache, Exported, Wish
from services.registry.bundle_file import SUFFIX, pack
from services.registry.models import ModelRegistry
from services.registry.records import State, VersionRecord
from services.supervisor.stream import SupervisedStreams

log = logging.getLogger(__name__)
NUMBER = re.compile(r"[0-9a-f]{16}")
ABOUT = "snapshot.json"
MANIFEST = "manifest.json"
MOST = 20


@dataclass(frozen=True)
class Snapshot:
    """Record of a stored snapshot: the model of a live stream after training on the frame `seq`."""

    id: str
    stream: str
    taken_at: str
    taken_by: str
    seq: int
    model_version: int
    gaussians: int
    time_window_s: list[float]
    pause_ms: float
    size_bytes: int
    digest: str
    """SHA-256 of the manifest, which contains the digest of the tensors."""


def described(folder: Path, stream: str, by: str, said: Mapping[str, Any]) -> Snapshot:
    """Create the record of a snapshot from its bundle folder and from `said`, the engine's answer to the command."""
    return Snapshot(
        id=secrets.token_hex(8),
        stream=stream,
        taken_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
        taken_by=by,
        size_bytes=sum(each.stat().st_size for each in folder.iterdir()),
        digest=hashlib.sha256((folder / MANIFEST).read_bytes()).hexdigest(),
        **{name: said[name] for name in ("seq", "model_version", "gaussians", "time_window_s", "pause_ms")},
    )


class SnapshotStore:
    """Snapshot folder with at most `most` snapshots per stream; the oldest is deleted. Thread-safe."""

    def __init__(self, folder: Path, most: int = MOST) -> None:
        self._folder, self._most = folder, most
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for left in folder.glob(".new-*"):
            shutil.rmtree(left)

    @contextmanager
    def new(self) -> Iterator[Path]:
        """Provide a temporary folder, deleted at the end of the block. `keep` moves a bundle out of it."""
        path = self._folder / f".new-{secrets.token_hex(8)}"
        try:
            path.mkdir(mode=0o700)
            yield path
        except OSError as error:
            raise ExportFailed(f"the snapshot was not kept: {error.strerror or error}; free space") from error
        finally:
            shutil.rmtree(path, ignore_errors=True)

    def keep(self, path: Path, made: Snapshot) -> None:
        """Move the bundle in a folder from `new` into the store, with its record."""
        write_durably(path / ABOUT, [json.dumps(asdict(made)).encode()])
        of_stream = self._folder / made.stream
        of_stream.mkdir(mode=0o700, exist_ok=True)
        os.rename(path, of_stream / made.id)
        sync_folder(of_stream)
        for old in self.all(made.stream)[self._most :]:
            with suppress(NoSnapshot):  # deleted by a concurrent request
                self.delete(made.stream, old.id)

    def all(self, stream: str) -> list[Snapshot]:
        """Return the snapshots of a stream, newest first."""
        folder = self._folder / stream
        found = []
        for name in os.listdir(folder) if folder.is_dir() else ():
            with suppress(NoSnapshot):  # deleted by a concurrent request
                found.append(self.get(stream, name))
        return sorted(found, key=lambda each: (each.taken_at, each.id), reverse=True)

    def get(self, stream: str, number: str) -> Snapshot:
        """Return one snapshot.

        Raises:
            NoSnapshot: if the snapshot does not exist, or its record is damaged.
        """
        try:
            return Snapshot(**json.loads((self.folder_of(stream, number) / ABOUT).read_text()))
        except FileNotFoundError:
            raise self._absent(stream) from None
        except (ValueError, TypeError) as error:
            log.warning("the record of snapshot %s of %s is damaged and ignored: %s", number, stream, error)
            raise self._absent(stream) from error

    def folder_of(self, stream: str, number: str) -> Path:
        """Return the bundle folder of a snapshot.

        Raises:
            NoSnapshot: if the snapshot does not exist.
        """
        path = self._folder / stream / number
        if not NUMBER.fullmatch(number) or not path.is_dir():
            raise self._absent(stream)
        return path

    def delete(self, stream: str, number: str) -> None:
        """Delete a snapshot.

        Raises:
            NoSnapshot: if the snapshot does not exist.
        """
        path = self.folder_of(stream, number)
        gone = self._folder / f".new-{secrets.token_hex(8)}"
        try:
            os.rename(path, gone)
        except FileNotFoundError:  # deleted by a concurrent request
            raise self._absent(stream) from None
        shutil.rmtree(gone)

    def _absent(self, stream: str) -> NoSnapshot:
        return NoSnapshot(f"there is no such snapshot of {stream}; GET /v1/streams/{stream}/snapshots lists them")


WRITE_S = 60.0
"""Seconds that an engine may take to write its model for a snapshot, before the command fails."""
CHECKED = (State.READY, State.ACTIVE, State.RETIRED)


class StreamSnapshots:
    """Takes snapshots of live streams by commands to their engines, and stores them as files or as model versions."""

    def __init__(self, streams: SupervisedStreams, registry: ModelRegistry, store: SnapshotStore) -> None:
        self._streams, self._registry, self._store = streams, registry, store

    async def take(self, stream: str, model: str | None, by: str) -> tuple[Snapshot, VersionRecord | None]:
        """Store the current live model of a stream as a snapshot.

        Args:
            stream: name of the stream.
            model: if given, the snapshot becomes the next version of this model, still to be
                checked. Otherwise it is stored as a file.
            by: the caller, for the record.

        Returns:
            The snapshot's record, and the version record or None.

        Raises:
            NotFound: if the stream does not exist.
            Conflict: if the stream is stopped or just starting.
            BusError: if the engine does not answer.
            ExportFailed: if the snapshot cannot be stored.
            RegistryError: if the registry rejects the snapshot as a version of `model`.
        """
        engine = self._streams.engine(stream)
        with self._store.new() as new:
            folder = new / "model"
            try:
                said = await engine.command("snapshot", timeout_s=WRITE_S, folder=str(folder))
            except CommandRefused as error:
                # The engine's message contains the path of a server folder, which callers must not see.
                raise Conflict(str(error).replace(str(folder), "the snapshot")) from error
            taken = await asyncio.to_thread(described, folder, stream, by, said)
            if model is None:
                await asyncio.to_thread(self._store.keep, folder, taken)
                return taken, None
            packed = new / f"model{SUFFIX}"
            await asyncio.to_thread(pack, folder, packed)
            return taken, await asyncio.to_thread(self._registry.upload, model, packed, None, by)

    def all(self, stream: str) -> Sequence[Snapshot]:
        """Return the stored snapshots of a stream, newest first."""
        return self._store.all(stream)

    def get(self, stream: str, number: str) -> Snapshot:
        """Return one snapshot. Raises NoSnapshot."""
        return self._store.get(stream, number)

    def delete(self, stream: str, number: str) -> None:
        """Delete a snapshot. Raises NoSnapshot."""
        self._store.delete(stream, number)


def refuse_outside(wish: Wish, window_s: Sequence[float]) -> None:
    """Refuse times outside the model's window before an export process is started.

    Raises:
        Rejected: if a time is outside.
    """
    start_s, end_s = window_s
    try:
        wish.times_in((start_s, end_s))
    except InvalidSetting as error:
        raise Rejected(str(error)) from error


class ModelExports:
    """Exports of models and snapshots to files. Synchronous and thread-safe."""

    def __init__(self, registry: ModelRegistry, store: SnapshotStore, cache: ExportCache) -> None:
        self._registry, self._store, self._cache = registry, store, cache

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Abort running exports at the end of the block."""
        try:
            yield
        finally:
            await asyncio.to_thread(self._cache.close)

    def of_version(self, name: str, number: int, wish: Wish) -> Exported:
        """Export or render a checked model version.

        Raises:
            RegistryError: if the version does not exist.
            ExportsError: if the export fails.
            Conflict: if the version was not checked.
            Rejected: if a requested time is outside of the model's window.
        """
        version: Any = self._registry.version(name, number)
        if version.state not in CHECKED:
            raise Conflict(f"{name}/{number} is {version.state}; only a version that passed its check is exported")
        refuse_outside(wish, version.description["time_window_s"])
        return self._cache.get(version.digest, lambda: self._registry.folder_of(name, number), wish)

    def of_snapshot(self, stream: str, number: str, wish: ExportWish) -> Exported:
        """Export a snapshot. Raises NoSnapshot, ExportsError."""
        snapshot = self._store.get(stream, number)
        refuse_outside(wish, snapshot.time_window_s)
        return self._cache.get(snapshot.digest, lambda: self._store.folder_of(stream, number), wish)
