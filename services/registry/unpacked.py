"""Unpacked versions as folders for `load_bundle`, created on demand from the stored file and
verified on each access."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gsplat_core.io.files import PartialFolder
from services.errors import BlobDamaged, Rejected, StoreUnavailable
from services.registry.blobs import BlobStore
from services.registry.bundle_file import MANIFEST, PIECE_BYTES, TENSORS, unpack

_log = logging.getLogger(__name__)


class UnpackedModels:
    """Folders named by content; versions with equal content share a folder. Safe for threads and
    several processes."""

    def __init__(self, folder: Path, incoming: Path, blobs: BlobStore, reached: Callable[[str], None]) -> None:
        self._folder, self._incoming, self._blobs, self._reached = folder, incoming, blobs, reached
        self._locks: dict[str, threading.Lock] = {}
        """Lock per folder. Prevents duplicate unpacking without blocking other folders."""
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
