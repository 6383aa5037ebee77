"""Folder of the registry: its lock, unpacked versions for `load_bundle`, and recovery at start.

Processes that publish uploads hold the lock in shared mode; cleanup holds it exclusively. Recovery deletes leftovers of
dead processes, and reports damaged files without changing them.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsplat_core.io.files import PartialFolder
from services.errors import BlobDamaged, Rejected, StoreUnavailable
from services.registry.blobs import BlobStore, StoredBlob
from services.registry.bundle_file import MANIFEST, PIECE_BYTES, SUFFIX, TENSORS, unpack
from services.registry.records import UNCHECKED, Recovery, State

_RETRY_S = 0.05


class FolderLock:
    """Lock on a file. Each use opens the file anew, so that threads of one process exclude each other, too."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @contextlib.contextmanager
    def shared(self) -> Iterator[None]:
        """Hold the lock in shared mode while the block runs. Waits for a cleanup, which holds it exclusively, to
        end."""
        with self._opened() as descriptor:
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            yield

    @contextlib.contextmanager
    def alone(self, wait_s: float) -> Iterator[bool]:
        """Try to hold the lock exclusively for up to `wait_s` seconds.

        Yields:
            True if the lock is held, False after the timeout.
        """
        until = time.monotonic() + wait_s
        with self._opened() as descriptor:
            while not _taken(descriptor):
                if time.monotonic() >= until:
                    yield False
                    return
                time.sleep(_RETRY_S)
            yield True

    @contextlib.contextmanager
    def _opened(self) -> Iterator[int]:
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            yield descriptor
        finally:
            os.close(descriptor)


def _taken(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


_log = logging.getLogger(__name__)


class UnpackedModels:
    """Folders with unpacked versions, named by their content; versions with equal content share a folder. Safe for
    threads and several processes."""

    def __init__(self, folder: Path, incoming: Path, blobs: BlobStore, reached: Callable[[str], None]) -> None:
        self._folder, self._incoming, self._blobs, self._reached = folder, incoming, blobs, reached
        self._locks: dict[str, threading.Lock] = {}
        """Lock per folder name, so that a version is unpacked once while other versions are not blocked."""
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def folder_of(self, row: Mapping[Any, Any]) -> Path:
        """Return the folder of a version, with verified digests.

        Raises:
            BlobDamaged: if the stored file is missing or altered.
            StoreUnavailable: if it cannot be read or unpacked.
        """
        target = self._folder / folder_name(row)
        with self._locks.setdefault(target.name, threading.Lock()):
            try:
                if not _is_intact(target, row):
                    if target.exists():
                        _log.warning(
                            "the unpacked copy of %s version %s was changed; it is made again",
                            row["name"],
                            row["version"],
                        )
                    self._make(target, row)
            except OSError as error:
                raise StoreUnavailable(
                    f"version {row['version']} of model {row['name']!r} cannot be unpacked: {error.strerror or error}; free space in the"
                    " registry's folder, and check its rights"
                ) from error
        return target

    def remove(self, row: Mapping[Any, Any]) -> None:
        """Delete a version's folder if it exists."""
        shutil.rmtree(self._folder / folder_name(row), ignore_errors=True)

    def remove_others(self, wanted: set[str]) -> list[str]:
        """Delete every folder not in `wanted`, including incomplete ones.

        Returns:
            The deleted names.
        """
        names = sorted(path.name for path in self._folder.iterdir() if path.name not in wanted)
        for name in names:
            shutil.rmtree(self._folder / name, ignore_errors=True)
        return names

    def _make(self, target: Path, row: Mapping[Any, Any]) -> None:
        with self._blobs.local_file(row["blob"], self._incoming) as path, PartialFolder(target) as partial:
            try:
                with open(path, "rb") as file:
                    unpack(file, os.fstat(file.fileno()).st_size, partial.path)
            except FileNotFoundError as error:
                raise _damaged(row, "is gone") from error
            except Rejected as error:
                raise _damaged(row, f"cannot be unpacked ({error})") from error
            self._reached("model unpacked")
            if not _is_intact(partial.path, row):
                raise _damaged(row, "is not what was uploaded")
            for name in (MANIFEST, TENSORS):
                os.chmod(partial.path / name, 0o400)
            earlier = partial.finish()
        if earlier is not None:
            shutil.rmtree(earlier, ignore_errors=True)


def folder_name(row: Mapping[Any, Any]) -> str:
    """Return the folder name of a version, derived from its digests."""
    return f"{row['tensors_sha256']}-{row['manifest_sha256'][:16]}"


def _is_intact(folder: Path, row: Mapping[Any, Any]) -> bool:
    if not folder.is_dir() or folder.is_symlink():
        return False
    return all(
        _sha256(folder / name) == row[column]
        for name, column in ((MANIFEST, "manifest_sha256"), (TENSORS, "tensors_sha256"))
    )


def _sha256(path: Path) -> str | None:
    """Return the SHA-256 of a regular file in hex, or None for anything else."""
    if path.is_symlink() or not path.is_file():
        return None
    sha256 = hashlib.sha256()
    with open(path, "rb") as file:
        while piece := file.read(PIECE_BYTES):
            sha256.update(piece)
    return sha256.hexdigest()


def _damaged(row: Mapping[Any, Any], what: str) -> BlobDamaged:
    return BlobDamaged(
        f"the stored file of version {row['version']} of model {row['name']!r} {what}; restore it from a backup, or delete the version and"
        " upload it again"
    )


_BLOB = re.compile(rf"[0-9a-f]{{64}}-[0-9a-f]{{16}}{re.escape(SUFFIX)}")
"""Format of keys created by this program. Other files in the store are left alone."""
Row = Mapping[Any, Any]


def remove_leftovers(
    rows: Sequence[Row], stored: Sequence[StoredBlob], blobs: BlobStore, incoming: Path, unpacked: UnpackedModels
) -> tuple[str, ...]:
    """Delete incomplete uploads, files without a version, and folders of deleted versions. Called
    under the exclusive lock.

    `stored` was listed before `rows` were read, so a file whose row was added in between is kept.

    Returns:
        Descriptions of the deleted items.
    """
    removed = []
    for path in sorted(incoming.iterdir()):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
        removed.append(f"half-written upload {path.name}")
    named = {row["blob"] for row in rows}
    for blob in stored:
        if blob.abandoned and blob.key not in named and _BLOB.fullmatch(blob.key):
            blobs.remove(blob.key)
            removed.append(f"upload {blob.key} that no version names")
    removed += [f"unpacked copy {name}" for name in unpacked.remove_others({folder_name(row) for row in rows})]
    for what in removed:
        _log.warning("removed at start: %s", what)
    return tuple(removed)


def findings(
    rows: Sequence[Row], stored: Sequence[StoredBlob], removed: tuple[str, ...], skipped: str | None
) -> Recovery:
    """Log unavailable files and return the result of a recovery: removed items, unchecked versions, damaged files."""
    sizes = {blob.key: blob.size for blob in stored}
    unchecked, damaged = [], []
    for row in rows:
        name, version = row["name"], row["version"]
        if State(row["state"]) in UNCHECKED:
            unchecked.append((name, version))
        size = sizes.get(row["blob"])
        if size != row["size_bytes"]:
            what = "is gone" if size is None else f"has {size} bytes in place of {row['size_bytes']}"
            damaged.append(
                (
                    name,
                    version,
                    f"the stored file of version {version} of model {name!r} {what}; restore it from a backup",
                )
            )
    for *_, sentence in damaged:
        _log.error("%s", sentence)
    if skipped is not None:
        _log.warning("%s", skipped)
    return Recovery(removed, tuple(unchecked), tuple(damaged), skipped)
