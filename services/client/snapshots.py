"""Snapshots and exports as methods."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path
from typing import Any

import httpx2
from pydantic import TypeAdapter

from gsplat_core.io.atomic_files import PartialFile
from services.client.errors import ClientError, Unreachable
from services.client.requests import Requests, refused_by
from services.control.routes.snapshots import SnapshotView

EXPORT_S = 330.0
"""A server may take so long for an export."""


class SnapshotMethods(Requests):
    """Methods of `Client` for snapshots and exports."""

    def take_snapshot(
        self, stream: str, model: str | None = None, *, idempotency_key: str | None = None
    ) -> SnapshotView:
        """Write a stream's live model as it stands: a file that is kept, or the next version of `model`."""
        headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
        wanted = {} if model is None else {"model": model}
        answer = self._ask("POST", f"/v1/streams/{stream}/snapshots", json=wanted, headers=headers)
        return SnapshotView.model_validate(answer)

    def snapshots(self, stream: str) -> list[SnapshotView]:
        """The snapshots of a stream that are kept, the newest first."""
        return TypeAdapter(list[SnapshotView]).validate_python(self._ask("GET", f"/v1/streams/{stream}/snapshots"))

    def delete_snapshot(self, stream: str, number: str) -> None:
        """Delete a snapshot."""
        self._ask("DELETE", f"/v1/streams/{stream}/snapshots/{number}")

    def export_version(self, name: str, number: int, format_name: str, file: Path, **wish: Any) -> int:
        """Write a version of a model into a file for other programs; returns its size. wish: `time_s`, or `times` of a sequence."""
        return self._download(f"/v1/models/{name}/versions/{number}/exports/{format_name}", file, wish)

    def export_snapshot(self, stream: str, number: str, format_name: str, file: Path, **wish: Any) -> int:
        """Write a snapshot into a file for other programs; returns its size."""
        return self._download(f"/v1/streams/{stream}/snapshots/{number}/exports/{format_name}", file, wish)

    def _download(self, path: str, file: Path, wish: dict[str, Any]) -> int:
        """The body of an answer as a file, which is whole or not there. Raises ClientError where it cannot be written, or is not what its digest says."""
        given = {name: value for name, value in wish.items() if value is not None}
        try:
            with PartialFile(file) as partial, self._http.stream("GET", path, params=given, timeout=EXPORT_S) as answer:
                if not answer.is_success:
                    answer.read()
                    raise refused_by(answer, self.url)
                sha256 = hashlib.sha256()
                for piece in answer.iter_bytes():
                    partial.file.write(piece)
                    sha256.update(piece)
                if f"sha-256=:{base64.b64encode(sha256.digest()).decode()}:" != answer.headers.get("content-digest"):
                    raise ClientError(f"{file.name} is not what the server's digest says; fetch it again")
                return partial.file.tell()
        except httpx2.HTTPError as error:
            raise Unreachable(f"{self.url} broke off: {error or type(error).__name__}; try again") from error
        except OSError as error:
            raise ClientError(f"{file} cannot be written: {error.strerror or error}") from error
