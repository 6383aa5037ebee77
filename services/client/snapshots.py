"""Client methods for snapshots and exports."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from services.client.requests import Requests
from services.schemas.streams import SnapshotView

EXPORT_S = 330.0
"""Timeout of an export in seconds."""


class SnapshotMethods(Requests):
    """Mixin of `Client` for snapshots and exports."""

    def take_snapshot(
        self, stream: str, model: str | None = None, *, idempotency_key: str | None = None
    ) -> SnapshotView:
        """Take a snapshot of a stream's live model, stored as a file or as the next version of
        `model`."""
        headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
        wanted = {} if model is None else {"model": model}
        answer = self._ask("POST", f"/v1/streams/{stream}/snapshots", json=wanted, headers=headers)
        return SnapshotView.model_validate(answer)

    def snapshots(self, stream: str) -> list[SnapshotView]:
        """Return the stored snapshots of a stream, newest first."""
        return TypeAdapter(list[SnapshotView]).validate_python(self._ask("GET", f"/v1/streams/{stream}/snapshots"))

    def delete_snapshot(self, stream: str, number: str) -> None:
        """Delete a snapshot."""
        self._ask("DELETE", f"/v1/streams/{stream}/snapshots/{number}")

    def export_version(
        self, name: str, number: int, format_name: str, file: Path, overwrite: bool = False, **wish: Any
    ) -> int:
        """Export a version of a model to a file. `wish`: `time_s`, or `times` of a sequence.

        Returns:
            Size of the file.
        """
        return self._download(f"/v1/models/{name}/versions/{number}/exports/{format_name}", file, wish, overwrite)

    def export_snapshot(
        self, stream: str, number: str, format_name: str, file: Path, overwrite: bool = False, **wish: Any
    ) -> int:
        """Export a snapshot to a file.

        Returns:
            Size of the file.
        """
        return self._download(f"/v1/streams/{stream}/snapshots/{number}/exports/{format_name}", file, wish, overwrite)

    def _download(self, path: str, file: Path, wish: dict[str, Any], overwrite: bool) -> int:
        """Download an export with the longer timeout EXPORT_S; see `Requests._get_file`."""
        given = {name: value for name, value in wish.items() if value is not None}
        return self._get_file(path, file, overwrite=overwrite, params=given, timeout=EXPORT_S)
