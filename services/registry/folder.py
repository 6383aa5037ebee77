"""Folder of the registry: its lock, unpacked versions for `load_bundle`, and recovery at start.

Processes that publish uploads hold the lock in shared mode; cleanup holds it exclusively. Recovery deletes leftovers of
dead processes, and reports damaged files without changing them.

Storage for uploaded files: a folder, or an object store by URL (fsspec). A key refers to a file that never changes.

An upload is first staged: copied next to the store, measured and hashed. It is rejected if it is not a model.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import fsspec

from gsplat_core.errors import BundleError
from gsplat_core.io.files import PartialFolder, beside, sync_folder, write_durably
from gsplat_core.io.model_files import open_model_file
from services.errors import BlobDamaged, Rejected, StoreUnavailable
from services.registry.bundle_file import MANIFEST, PIECE_BYTES, SUFFIX, TENSORS, digest_of, members_of, unpack
from services.registry.records import UNCHECKED, Recovery, State

PART_SUFFIX = ".part"
"""Name suffix of files and folders that are still being written."""
OTHERS_UPLOAD_S = 3600.0
"""Age in seconds below which unreferenced files of an object store are kept, because another machine may insert
their database row soon."""


@dataclass(frozen=True)
class StoredBlob:
    """File in a blob store. `abandoned` is True if the file, when no database row references it, is a leftover
    rather than a running upload."""

    key: str
    size: int
    abandoned: bool


class BlobStore(Protocol):
    """Key-to-file storage. Every method raises StoreUnavailable if the store fails or does not answer."""

    def publish(self, staged: Path, key: str) -> None:
        """Store a complete, synced local file under a new key, atomically. The local file may be moved away."""

    def local_file(self, key: str, folder: Path) -> contextlib.AbstractContextManager[Path]:
        """Context manager that yields a local path of the file. A remote file is downloaded into `folder` for the
        block."""

    def remove(self, key: str) -> None:
        """Delete the file; no effect if it does not exist."""

    def stored(self) -> list[StoredBlob]:
        """List every file of the store."""


def open_blobs(url: str | None, folder: Path, options: dict[str, Any] | None = None) -> BlobStore:
    """Open the blob store at a URL such as `s3://bucket/prefix`, or in `folder` without a URL.

    Credentials come from the store's usual environment variables (AWS_ACCESS_KEY_ID and so on).

    Args:
        url: address of the store, or None.
        folder: local folder.
        options: options of the fsspec file system.

    Raises:
        StoreUnavailable: if the URL scheme is unknown or its package is not installed.
    """
    if url is None:
        return FolderBlobs(folder)
    return RemoteBlobs(url, options or {})


class FolderBlobs:
    """Blob store in a local folder, one file per key."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def publish(self, staged: Path, key: str) -> None:
        with _store_errors(str(self.folder)):
            os.chmod(staged, 0o400)
            os.rename(staged, self.folder / key)
            sync_folder(self.folder)

    @contextlib.contextmanager
    def local_file(self, key: str, folder: Path) -> Iterator[Path]:
        yield self.folder / key

    def remove(self, key: str) -> None:
        with _store_errors(str(self.folder)):
            (self.folder / key).unlink(missing_ok=True)

    def stored(self) -> list[StoredBlob]:
        # All files count as abandoned, because only this machine writes into the folder and the caller holds the
        # registry's lock.
        with _store_errors(str(self.folder)):
            return [
                StoredBlob(path.name, path.stat().st_size, abandoned=True) for path in sorted(self.folder.iterdir())
            ]


class RemoteBlobs:
    """Blob store in an object store, where an object appears only after its complete upload."""

    def __init__(self, url: str, options: dict[str, Any], others_upload_s: float = OTHERS_UPLOAD_S) -> None:
        self._others_upload_s = others_upload_s
        try:
            self._files, self._root = fsspec.core.url_to_fs(url, **options)
        except (ImportError, ValueError) as error:
            raise StoreUnavailable(
                f"the blob store {url} cannot be used: {error}; give s3://BUCKET/PREFIX with the extra `s3`, or no URL for a folder"
            ) from error
        self._url = url

    def publish(self, staged: Path, key: str) -> None:
        with _store_errors(self._url):
            self._files.put_file(str(staged), self._path(key))
            self._files.invalidate_cache()
            arrived, sent = self._files.info(self._path(key))["size"], staged.stat().st_size
        if arrived != sent:
            raise StoreUnavailable(
                f"the blob store {self._url} has {arrived} of {sent} bytes of {key}; upload it again"
            )

    @contextlib.contextmanager
    def local_file(self, key: str, folder: Path) -> Iterator[Path]:
        fetched = beside(folder / key, PART_SUFFIX)
        try:
            with _store_errors(self._url):
                self._files.get_file(self._path(key), str(fetched))
            yield fetched
        finally:
            fetched.unlink(missing_ok=True)

    def remove(self, key: str) -> None:
        with _store_errors(self._url), contextlib.suppress(FileNotFoundError):
            self._files.rm_file(self._path(key))

    def stored(self) -> list[StoredBlob]:
        with _store_errors(self._url):
            self._files.invalidate_cache()
            try:
                found = self._files.ls(self._root, detail=True)
            except FileNotFoundError:
                return []  # the prefix has no objects yet
        return [
            StoredBlob(
                each["name"].rsplit("/", 1)[-1],
                int(each["size"]),
                _written_before(each, time.time() - self._others_upload_s),
            )
            for each in found
            if each["type"] == "file"
        ]

    def _path(self, key: str) -> str:
        return f"{self._root.rstrip('/')}/{key}"


def _written_before(described: dict[str, Any], moment_s: float) -> bool:
    """Return True if a file is older than a Unix time in seconds; False if the store reports no
    time. Stores report a datetime or a Unix time."""
    written = described.get("LastModified", described.get("created"))
    if written is None:
        return False
    return float(written if isinstance(written, int | float) else written.timestamp()) < moment_s


@contextlib.contextmanager
def _store_errors(where: str) -> Iterator[None]:
    """Convert exceptions of a store or its package to StoreUnavailable. botocore's errors derive
    from Exception directly."""
    try:
        yield
    except FileNotFoundError as error:
        raise StoreUnavailable(
            f"the blob store {where} has no {error.filename or error}; restore it from a backup"
        ) from error
    except OSError as error:
        raise StoreUnavailable(
            f"the blob store {where} cannot be used: {error.strerror or error}; check its space, its rights and its address"
        ) from error
    except Exception as error:
        if not type(error).__module__.startswith(("botocore", "aiobotocore", "aiohttp")):
            raise
        raise StoreUnavailable(
            f"the blob store {where} does not answer: {error}; check its address and credentials"
        ) from error


@dataclass(frozen=True)
class StagedUpload:
    """Complete upload on the local disk, with its measurements."""

    path: Path
    size_bytes: int
    digest: str
    manifest_sha256: str
    tensors_sha256: str


def stage(file: Path, incoming: Path, digest: str | None, most_bytes: int) -> StagedUpload:
    """Copy an upload durably into `incoming`, so the caller can no longer change it, and parse its
    container. On errors nothing is left behind.

    Args:
        file: the upload.
        incoming: folder for the copy.
        digest: SHA-256 stated by the sender, in hex, or None.
        most_bytes: largest upload in bytes.

    Raises:
        Rejected: if the file is too large, has another digest, or another format.
        StoreUnavailable: if the file cannot be read or the disk is full.
    """
    target = beside(incoming / "upload", PART_SUFFIX)
    copy = _Copy(most_bytes)
    try:
        try:
            with open_model_file(file) as source:
                write_durably(target, copy.pieces(source))
        except (OSError, BundleError) as error:
            reason = getattr(error, "strerror", None) or error
            raise StoreUnavailable(f"the upload cannot be kept: {reason}; free space, or upload it again") from error
        found = copy.sha256.hexdigest()
        if digest is not None and digest.lower() != found:
            raise Rejected(f"the file has SHA-256 {found}, its sender said {digest[:80]}; upload it again")
        with open(target, "rb") as staged:
            manifest, tensors = members_of(staged, os.fstat(staged.fileno()).st_size)
            return StagedUpload(target, copy.size, found, digest_of(staged, manifest), digest_of(staged, tensors))
    except BaseException:
        target.unlink(missing_ok=True)
        raise


class _Copy:
    """Copy of an upload in progress: counts the bytes against the limit and hashes them."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self.size = 0
        self.sha256 = hashlib.sha256()

    def pieces(self, source: BinaryIO) -> Iterator[bytes]:
        while piece := source.read(PIECE_BYTES):
            self.size += len(piece)
            if self.size > self._most_bytes:
                raise Rejected(
                    f"the file has more than {self._most_bytes} bytes; upload a smaller model, or raise the limit"
                )
            self.sha256.update(piece)
            yield piece


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
        """Try for up to `wait_s` seconds to take the lock exclusively. It is held while the block runs.

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
