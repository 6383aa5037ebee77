"""Protocols of the snapshot store and the model exporter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, BinaryIO, Protocol

from gsplat_core.io.exports.formats import ExportWish


class ExportedFile(Protocol):
    """Exported file, open for reading. The caller closes it."""

    @property
    def file(self) -> BinaryIO: ...
    @property
    def sha256(self) -> str: ...
    @property
    def size_bytes(self) -> int: ...


class Snapshots(Protocol):
    """Snapshots of live streams. `Parts.errors` names their errors."""

    async def take(self, stream: str, model: str | None, by: str) -> tuple[Any, Any]:
        """Write the current live model of a stream.

        Args:
            stream: name of the stream.
            model: if given, the snapshot becomes the next version of this model, still to be
                checked. Otherwise it is stored as a file.
            by: the caller, for the record.

        Returns:
            The snapshot's record, and the version record or None.
        """

    def all(self, stream: str) -> Sequence[Any]:
        """Return the stored snapshots of a stream, newest first. Synchronous, like the methods
        below."""

    def get(self, stream: str, number: str) -> Any: ...
    def delete(self, stream: str, number: str) -> None: ...


class Exports(Protocol):
    """Exporter of models and snapshots to files. Synchronous and thread-safe; a separate process
    creates missing exports."""

    def of_version(self, name: str, number: int, wish: ExportWish) -> ExportedFile: ...
    def of_snapshot(self, stream: str, number: str, wish: ExportWish) -> ExportedFile: ...
