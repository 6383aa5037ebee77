"""Exports that were made, found again by the digest of what they were made of; the oldest leave when there are too many."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import shutil
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from gsplat_core.io.exports.formats import ExportWish
from services.exports.errors import ExportBusy, ExportFailed
from services.exports.programs import ExportPrograms

REVISION = 1
"""Changes when the same model gives other bytes."""
MOST_BYTES = 2 << 30
AT_ONCE = 1
MOST_WAITING = 8


@dataclass(frozen=True)
class Exported:
    """A file that was made. `file` is open, so that it can be read to its end whatever leaves the cache meanwhile."""

    file: BinaryIO
    sha256: str
    """In hex."""
    size_bytes: int


class ExportCache:
    """Makes exports, one at a time, and keeps them. Any thread may use it; one process uses a folder."""

    def __init__(
        self,
        folder: Path,
        *,
        most_bytes: int = MOST_BYTES,
        most_waiting: int = MOST_WAITING,
        programs: ExportPrograms | None = None,
    ) -> None:
        """folder: made, and emptied of what was left half made."""
        self._folder, self._most_bytes = folder, most_bytes
        self._programs = programs or ExportPrograms()
        self._lock = threading.Lock()
        self._making: dict[str, threading.Lock] = {}
        self._turn = threading.BoundedSemaphore(AT_ONCE)
        self._waiting, self._most_waiting = 0, most_waiting
        self.made = 0
        """Exports that were made, and not found."""
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for left in folder.glob("new-*"):
            shutil.rmtree(left)

    def get(self, digest: str, folder_of: Callable[[], Path], wish: ExportWish) -> Exported:
        """An export of the model that has this digest; `folder_of` gives its unpacked files where it has to be made.

        Raises ExportRefused, ExportBusy, ExportFailed.
        """
        key = hashlib.sha256(
            json.dumps([REVISION, digest, wish.format.name, wish.time_s, wish.times]).encode()
        ).hexdigest()
        with self._queued(), self._lock_of(key):
            found = self._open(key)
            if found is None:
                with self._turn:
                    self._make(key, folder_of(), wish)
                found = self._open(key)
        if found is None:
            raise ExportFailed(f"the export is larger than the {self._most_bytes} bytes that are kept; ask for less")
        return found

    def close(self) -> None:
        """End what is being made."""
        self._programs.end()

    @contextlib.contextmanager
    def _queued(self) -> Iterator[None]:
        with self._lock:
            if self._waiting >= self._most_waiting:
                raise ExportBusy(f"{self._waiting} exports wait already; ask again in a minute")
            self._waiting += 1
        try:
            yield
        finally:
            with self._lock:
                self._waiting -= 1

    @contextlib.contextmanager
    def _lock_of(self, key: str) -> Iterator[None]:
        """Who asks for the same waits for the first one."""
        with self._lock:
            lock = self._making.setdefault(key, threading.Lock())
        with lock:
            yield
        with self._lock:
            if not lock.locked():
                self._making.pop(key, None)

    def _open(self, key: str) -> Exported | None:
        with self._lock:
            try:
                about = json.loads((self._folder / f"{key}.json").read_text())
                file = open(self._folder / f"{key}.data", "rb")  # noqa: SIM115 - whoever asked closes it
            except (FileNotFoundError, ValueError):
                return None
            os.utime(self._folder / f"{key}.data")
            return Exported(file, about["sha256"], about["size_bytes"])

    def _make(self, key: str, source: Path, wish: ExportWish) -> None:
        new = self._folder / f"new-{secrets.token_hex(8)}"
        try:
            new.mkdir(mode=0o700)
            file = new / f"model{wish.format.suffix}"
            self._programs.make(source, file, wish)
            with file.open("rb") as made:
                sha256 = hashlib.file_digest(made, "sha256").hexdigest()
            about = {"sha256": sha256, "size_bytes": file.stat().st_size}
            (new / "about").write_text(json.dumps(about))
            with self._lock:
                os.replace(file, self._folder / f"{key}.data")
                os.replace(new / "about", self._folder / f"{key}.json")
                self.made += 1
                self._evict()
        except OSError as error:
            raise ExportFailed(
                f"the export was not kept: {error.strerror or error}; free space and try again"
            ) from error
        finally:
            shutil.rmtree(new, ignore_errors=True)

    def _evict(self) -> None:
        """Under the lock: let go of the oldest until the rest is small enough."""
        files = sorted(self._folder.glob("*.data"), key=lambda path: path.stat().st_mtime_ns)
        total = sum(path.stat().st_size for path in files)
        for path in files:
            if total <= self._most_bytes:
                return
            total -= path.stat().st_size
            path.with_suffix(".json").unlink(missing_ok=True)
            path.unlink()
