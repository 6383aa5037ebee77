"""Queries that convert between the registry's rows and records."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from services.errors import NotFound
from services.registry.records import ModelRecord, State, VersionRecord
from services.registry.tables import ACTIVATIONS, MODELS, VERSIONS


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
    """Set the active version of a model."""
    connection.execute(sa.update(MODELS).where(MODELS.c.name == name).values(active=version))


def activation_steps(connection: sa.Connection, name: str) -> list[tuple[int, int]]:
    """Return (step, version) of every activation that was not rolled back, oldest first."""
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
