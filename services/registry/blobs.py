"""Where uploaded files are kept: a folder, or an object store by URL (fsspec). A key names a whole file or nothing."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import fsspec

from gsplat_core.io.files import beside, sync_folder
from services.registry.errors import StoreUnavailable

PART_SUFFIX = ".part"
"""What half-written files and folders end in."""
OTHERS_UPLOAD_S = 3600.0
"""A remote file that belongs to no version is left alone for so long: another machine may be about to name it."""


@dataclass(frozen=True)
class StoredBlob:
    """A file in a store. `abandoned`: nobody can be about to name it in the database any more."""

    key: str
    size: int
    abandoned: bool


class BlobStore(Protocol):
    """Files under keys. Everything raises StoreUnavailable where the store does not answer or take it."""

    def publish(self, staged: Path, key: str) -> None:
        """Store the complete, synced local file under a new key, in one step: afterwards it is there whole, before not at all. The local
        file may be gone."""

    def local_file(self, key: str, folder: Path) -> contextlib.AbstractContextManager[Path]:
        """The file on this machine's disk while entered; one that lies elsewhere is fetched into `folder`."""

    def remove(self, key: str) -> None:
        """Remove it; nothing happens where it is not there."""

    def stored(self) -> list[StoredBlob]:
        """Every file of the store."""


def open_blobs(url: str | None, folder: Path, options: dict[str, Any] | None = None) -> BlobStore:
    """The store at a URL such as `s3://bucket/prefix`; without one the folder. options: those of the fsspec file system.

    Credentials come from the environment, as the store's own tools read them (AWS_ACCESS_KEY_ID and so on). Raises StoreUnavailable for an
    unknown kind of URL and where the package for it is not installed.
    """
    if url is None:
        return FolderBlobs(folder)
    return RemoteBlobs(url, options or {})


class FolderBlobs:
    """A folder on the machine's disk."""

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
        # Only this machine writes here, and whoever asks holds the registry's lock.
        with _store_errors(str(self.folder)):
            return [
                StoredBlob(path.name, path.stat().st_size, abandoned=True) for path in sorted(self.folder.iterdir())
            ]


class RemoteBlobs:
    """An object store: an object is there when all of it has arrived, and not before."""

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
                return []  # a prefix that holds nothing yet
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
    """Return True if a file is older than a moment, False where its store does not say. Stores give a datetime, or a Unix time in seconds."""
    written = described.get("LastModified", described.get("created"))
    if written is None:
        return False
    return float(written if isinstance(written, int | float) else written.timestamp()) < moment_s


@contextlib.contextmanager
def _store_errors(where: str) -> Iterator[None]:
    """What a store or its package raises, as StoreUnavailable. botocore's errors derive from Exception alone."""
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
