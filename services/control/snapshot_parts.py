"""Protocols of the parts that take snapshots of streams and export models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, BinaryIO, Protocol

from gsplat_core.io.exports.formats import ExportWish


class ExportedFile(Protocol):
    """A file that was made; whoever asked for it closes it."""

    @property
    def file(self) -> BinaryIO: ...
    @property
    def sha256(self) -> str: ...
    @property
    def size_bytes(self) -> int: ...


class Snapshots(Protocol):
    """Snapshots of live streams. Their errors are named in `Parts.errors`."""

    async def take(self, stream: str, model: str | None, by: str) -> tuple[Any, Any]:
        """Write the live model as it stands after a frame. Without `model` it is kept as a file: a snapshot and None. With it, it becomes that
        model's next version, which is to be checked: what is known of the snapshot, and the version's record."""

    def all(self, stream: str) -> Sequence[Any]:
        """Those of a stream that are kept, the newest first. For a thread, as what follows."""

    def get(self, stream: str, number: str) -> Any: ...
    def delete(self, stream: str, number: str) -> None: ...


class Exports(Protocol):
    """Models and snapshots as files. Synchronous and safe for threads; a process of its own makes what is not there yet."""

    def of_version(self, name: str, number: int, wish: ExportWish) -> ExportedFile: ...
    def of_snapshot(self, stream: str, number: str, wish: ExportWish) -> ExportedFile: ...
