"""Protocols of the recording store and of replay jobs.

Both are synchronous and thread-safe; the API calls them in worker threads. `Parts.errors` names
their errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol


class RecordingRecord(Protocol):
    """Record of an uploaded recording."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def state(self) -> str: ...
    @property
    def reason(self) -> str | None: ...
    @property
    def digest(self) -> str: ...
    @property
    def size_bytes(self) -> int: ...
    @property
    def kept_bytes(self) -> int: ...
    @property
    def uploaded_at(self) -> Any: ...
    @property
    def uploaded_by(self) -> str: ...
    @property
    def description(self) -> Mapping[str, Any]: ...


class Recordings(Protocol):
    """Store of uploaded recordings."""

    def add(self, name: str, file: Path, digest: str, by: str) -> tuple[RecordingRecord, bool]:
        """Move a file into the store.

        Args:
            name: name of the recording.
            file: path of the upload.
            digest: its SHA-256 in hex.
            by: the caller, for the record.

        Returns:
            The record, and False if the same file is already stored under this name.
        """
        ...

    def check(self, name: str) -> RecordingRecord:
        """Validate a recording and mark it ready, or rejected with a reason."""
        ...

    def all(self) -> Sequence[RecordingRecord]: ...
    def get(self, name: str) -> RecordingRecord: ...
    def delete(self, name: str) -> RecordingRecord: ...


class JobRecord(Protocol):
    """Record of a replay job."""

    @property
    def id(self) -> str: ...
    @property
    def number(self) -> int: ...
    @property
    def batch(self) -> str: ...
    @property
    def recording(self) -> str: ...
    @property
    def folder(self) -> str: ...
    @property
    def options(self) -> Mapping[str, Any]: ...
    @property
    def state(self) -> str: ...
    @property
    def reason(self) -> str | None: ...
    @property
    def is_open(self) -> bool: ...


class Submission(Protocol):
    """Result of a submission: one job per recording."""

    @property
    def batch(self) -> str: ...
    @property
    def ids(self) -> Sequence[str]: ...
    @property
    def is_new(self) -> bool: ...


class Jobs(Protocol):
    """Queue of replay jobs."""

    def submit(
        self, recordings: Sequence[str], options: Mapping[str, Any], by: str, idempotency_key: str | None
    ) -> Submission: ...

    def newest(
        self, count: int, *, before: int | None, batch: str | None, state: str | None
    ) -> Sequence[JobRecord]: ...

    def get(self, job_id: str) -> JobRecord: ...
    def counts(self, batch: str | None = None) -> Mapping[str, int]: ...
    def cancel(self, job_id: str, by: str) -> JobRecord: ...
    def delete(self, job_id: str) -> JobRecord:
        """Delete a finished replay and its results."""
        ...

    def files(self, job: JobRecord) -> Sequence[str]:
        """Return the names of the result files."""
        ...

    def file(self, job_id: str, name: str) -> Path:
        """Return the path of a result file."""
        ...
