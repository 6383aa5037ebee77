"""Storage for uploaded files: a folder, or an object store by URL (fsspec). A key refers to a file that never changes.

An upload is first staged: copied next to the store, measured and hashed. It is rejected if it is not a model.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import fsspec

from gsplat_core.errors import BundleError
from gsplat_core.io.files import beside, sync_folder, write_durably
from gsplat_core.io.model_files import open_model_file
from services.errors import Rejected, StoreUnavailable
from services.registry.bundle_file import PIECE_BYTES, digest_of, members_of

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
