"""Records of the registry: versions, models and changes, their tables, and the queries that convert between rows and records.

Each change of a table needs a new file in `migrations`.

Resource budgets of uploads and their checks, and resource limits of the processes that read uploads.
"""

from __future__ import annotations

import math
import os
import resource
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from services.errors import NotFound


class State(StrEnum):
    """State of a version: uploaded → validated → ready → active → retired, or rejected with a reason."""

    UPLOADED = "uploaded"
    """File stored, content not checked yet."""
    VALIDATED = "validated"
    """Content valid; the warm-up picture is being rendered."""
    READY = "ready"
    """Check passed; the version can be activated."""
    ACTIVE = "active"
    """Version that streams display if their settings name this model."""
    RETIRED = "retired"
    """Version that was active earlier; it can be activated again."""
    REJECTED = "rejected"
    """Check failed; `reason` has the cause."""


UNCHECKED = (State.UPLOADED, State.VALIDATED)
ACTIVATABLE = (State.READY, State.RETIRED)


@dataclass(frozen=True)
class VersionRecord:
    """Version of a model. Name, number, digests and size never change."""

    name: str
    version: int
    state: State
    reason: str | None
    """Reason of a rejection or a rollback; None if there was none."""
    digest: str
    """SHA-256 of the uploaded file in hex."""
    size_bytes: int
    """Size of the uploaded file in bytes."""
    uploaded_by: str
    uploaded_at: datetime
    changed_by: str
    """Caller that caused the current state."""
    changed_at: datetime
    description: dict[str, Any] = field(default_factory=dict)
    """Results of the check: gaussians, parameters, field, renderer, width_px, height_px, time_window_s, model_sha256,
    render_ms, covered (share of pixels with an opacity above 0.5). Empty before the check. Partial or empty after a
    rejection.
    """


@dataclass(frozen=True)
class ModelRecord:
    """Model. Its version numbers increase and are never reused."""

    name: str
    created_at: datetime
    active: int | None
    """Number of the active version; None if no version is active."""
    last_version: int
    """Highest version number used so far, including deleted versions."""


@dataclass(frozen=True, kw_only=True)
class Change(VersionRecord):
    """Version after a change (before it, for a deletion), with the data of an audit entry."""

    action: str
    """Kind of change: activate, rollback or delete."""
    by: str
    at: datetime
    active_before: int | None
    active_after: int | None
    why: str | None = None

    def entry(self) -> dict[str, Any]:
        """Return the audit entry in JSON types. `object_digest` identifies the uploaded file."""
        return {
            "action": f"model.{self.action}",
            "model": self.name,
            "version": self.version,
            "state": str(self.state),
            "object_digest": f"sha-256:{self.digest}",
            "by": self.by,
            "at": self.at.isoformat(),
            "active_before": self.active_before,
            "active_after": self.active_after,
            "why": self.why,
        }


@dataclass(frozen=True)
class Recovery:
    """Result of `recover`. Only `removed` items were changed; the rest needs an administrator's decision."""

    removed: tuple[str, ...] = ()
    """Descriptions of the deleted incomplete files and files that belong to no version."""
    unchecked: tuple[tuple[str, int], ...] = ()
    """Model name and number of each version whose check did not finish; `check` repeats it."""
    damaged: tuple[tuple[str, int, str], ...] = ()
    """Model name, number and a message for each version whose stored file is missing or has another size."""
    skipped: str | None = None
    """Reason why no leftovers were removed; None if the cleanup ran."""


METADATA = sa.MetaData(
    naming_convention={
        "pk": "pk_%(table_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s",
        "ix": "ix_%(table_name)s_%(column_0_name)s",
    }
)
MODELS = sa.Table(
    "models",
    METADATA,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("created_at", sa.String(40), nullable=False),
    sa.Column("last_version", sa.Integer, nullable=False),
    sa.Column("active", sa.Integer, nullable=True),
)
"""Table of models. `active` is the number of the active version; an activation updates only this row of the table."""
VERSIONS = sa.Table(
    "versions",
    METADATA,
    sa.Column("name", sa.String(64), sa.ForeignKey("models.name"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("reason", sa.Text, nullable=True),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("size_bytes", sa.BigInteger, nullable=False),
    sa.Column("manifest_sha256", sa.String(64), nullable=False),
    sa.Column("tensors_sha256", sa.String(64), nullable=False),
    sa.Column("blob", sa.String(128), nullable=False),
    sa.Column("uploaded_by", sa.String(200), nullable=False),
    sa.Column("uploaded_at", sa.String(40), nullable=False),
    sa.Column("changed_by", sa.String(200), nullable=False),
    sa.Column("changed_at", sa.String(40), nullable=False),
    sa.Column("description", sa.JSON, nullable=False),
)
"""Versions. Times are ISO 8601 in UTC. `blob` is the key of the uploaded file in the blob store."""
ACTIVATIONS = sa.Table(
    "activations",
    METADATA,
    sa.Column("name", sa.String(64), sa.ForeignKey("models.name"), primary_key=True),
    sa.Column("step", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("version", sa.Integer, nullable=False),
)
"""History of active versions, oldest first. An activation appends a row; a rollback deletes it."""


def now() -> datetime:
    """Return the wall-clock time in UTC, truncated to milliseconds like the stored times."""
    at = datetime.now(UTC)
    return at.replace(microsecond=at.microsecond // 1000 * 1000)


def model_row(connection: sa.Connection, name: str) -> sa.RowMapping:
    """Return the row of a model.

    Raises:
        NotFound: if the model does not exist.
    """
    row = connection.execute(sa.select(MODELS).where(MODELS.c.name == name)).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no model {name[:80]!r}; upload a version of it first")
    return row


def version_row(connection: sa.Connection, name: str, version: int) -> sa.RowMapping:
    """Return the row of a version.

    Raises:
        NotFound: if the model or the version does not exist.
    """
    query = sa.select(VERSIONS).where(VERSIONS.c.name == name, VERSIONS.c.version == version)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        model_row(connection, name)
        raise NotFound(f"model {name!r} has no version {version}; list its versions for those that are there")
    return row


def version_rows(connection: sa.Connection, name: str | None = None) -> list[sa.RowMapping]:
    """Return the rows of all versions, or of one model, in order."""
    query = sa.select(VERSIONS).order_by(VERSIONS.c.name, VERSIONS.c.version)
    if name is not None:
        query = query.where(VERSIONS.c.name == name)
    return list(connection.execute(query).mappings())


def change_state(
    connection: sa.Connection, name: str, version: int, state: State, by: str, at: datetime, **values: Any
) -> None:
    """Update a version's state, the acting caller, the time and further columns."""
    changed = {"state": str(state), "changed_by": by, "changed_at": at.isoformat(), **values}
    connection.execute(
        sa.update(VERSIONS).where(VERSIONS.c.name == name, VERSIONS.c.version == version).values(changed)
    )


def set_active(connection: sa.Connection, name: str, version: int) -> None:
    """Set the active version number in a model's row."""
    connection.execute(sa.update(MODELS).where(MODELS.c.name == name).values(active=version))


def activation_steps(connection: sa.Connection, name: str) -> list[tuple[int, int]]:
    """Return the ascending number and the version of every activation that was not rolled back, oldest first."""
    query = sa.select(ACTIVATIONS.c.step, ACTIVATIONS.c.version).where(ACTIVATIONS.c.name == name)
    return [(row.step, row.version) for row in connection.execute(query.order_by(ACTIVATIONS.c.step))]


def version_record(row: sa.RowMapping) -> VersionRecord:
    """Convert a row to a version record."""
    return VersionRecord(
        name=row["name"],
        version=row["version"],
        state=State(row["state"]),
        reason=row["reason"],
        digest=row["digest"],
        size_bytes=row["size_bytes"],
        uploaded_by=row["uploaded_by"],
        uploaded_at=datetime.fromisoformat(row["uploaded_at"]),
        changed_by=row["changed_by"],
        changed_at=datetime.fromisoformat(row["changed_at"]),
        description=dict(row["description"]),
    )


def model_record(row: sa.RowMapping) -> ModelRecord:
    """Convert a row to a model record."""
    return ModelRecord(
        name=row["name"],
        created_at=datetime.fromisoformat(row["created_at"]),
        active=row["active"],
        last_version=row["last_version"],
    )


GIB = 1 << 30


MOST_UPLOAD_BYTES = 4 * GIB
"""Default for the largest upload in bytes."""
MOST_GAUSSIANS = 2_000_000
MOST_TENSOR_BYTES = 4 * GIB
"""Largest total size of the tensors in memory, in bytes."""
MOST_PIXELS = 4096 * 4096
"""Maximum number of pixels of the pictures of an uploaded model's camera."""
CHECK_MEMORY_BYTES = 12 * GIB
"""Memory limit of the checking process on the CPU, beyond what torch uses at its start, in bytes."""
CHECK_S = 120.0
"""Processor time of the check in seconds, without the start of torch. Exceeding it rejects the version."""
CHECK_PASSED_S = 600.0
"""Wall-clock time of a check in seconds, including process start. Exceeding it means that the machine is too busy, and the
version is not rejected.
"""
NICENESS = 10
"""Nice value of a check; running streams have priority."""


def taken_bytes() -> int:
    """Return this process's current data size in bytes, as counted for RLIMIT_DATA."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    return int(fields["VmData"].split()[0]) * 1024


def lower_limit(kind: int, wanted: int, spare: int = 0) -> None:
    """Lower a resource limit; a lower existing limit is kept.

    Args:
        kind: resource, such as `resource.RLIMIT_CPU`.
        wanted: soft limit.
        spare: distance of the hard limit above the soft limit. For processor time, SIGXCPU comes at the soft limit.
    """
    _, hard = resource.getrlimit(kind)
    allowed = [wanted, wanted + spare]
    if hard != resource.RLIM_INFINITY:
        allowed = [min(each, hard) for each in allowed]
    resource.setrlimit(kind, (allowed[0], allowed[1]))


def limit_resources(device: str) -> None:
    """Limit processor time and memory beyond what torch used at its start, and disable core files.

    Memory is not limited on CUDA, which maps far more address space than it uses.
    """
    os.nice(NICENESS)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if device == "cpu":
        lower_limit(resource.RLIMIT_DATA, taken_bytes() + CHECK_MEMORY_BYTES)
    lower_limit(resource.RLIMIT_CPU, math.ceil(time.process_time() + CHECK_S), spare=5)


_MEMORY_WORDS = ("can't allocate memory", "cannot allocate memory", "out of memory", "bad_alloc")


def says_out_of_memory(error: Exception) -> bool:
    """Return True for a MemoryError, and for the RuntimeError that torch's allocators raise in place of it."""
    return not isinstance(error, RuntimeError) or any(words in str(error).lower() for words in _MEMORY_WORDS)
