"""Database rows of an upload, written after the file is completely stored."""

from __future__ import annotations

import re

import sqlalchemy as sa

from services.errors import Conflict, NotFound, Rejected
from services.registry.records import State, VersionRecord
from services.registry.rows import model_row, now, version_record, version_row
from services.registry.staging import StagedUpload
from services.registry.tables import MODELS, VERSIONS

MODEL_NAME = re.compile(r"[a-z0-9](?:[a-z0-9._-]{0,62}[a-z0-9])?")
LAST_NUMBER = (1 << 31) - 1
MOST_BY = 200


def check_name(name: str) -> None:
    """Check a model name.

    Raises:
        Rejected: if the name is not valid.
    """
    if not MODEL_NAME.fullmatch(name):
        raise Rejected(
            f"{name[:80]!r} cannot be the name of a model; take up to 64 of a-z, 0-9, dot, dash and underscore, with a letter or digit at both ends"
        )


def check_by(by: str) -> None:
    """Check the name of the acting caller.

    Raises:
        Rejected: if the name is empty, too long or not printable.
    """
    if not by or len(by) > MOST_BY or not by.isprintable():
        raise Rejected(f"`by` must be 1 to {MOST_BY} printable characters that say who asks, got {by[:80]!r}")


def add_version(
    connection: sa.Connection, name: str, wanted: int | None, upload: StagedUpload, blob: str, by: str
) -> VersionRecord:
    """Insert the row of a stored upload, and the model's row for its first version.

    Args:
        wanted: required version number; None takes the next one.

    Raises:
        Conflict: if the number was already used.
    """
    at = now().isoformat()
    last = _last_version(connection, name, at)
    number = last + 1 if wanted is None else wanted
    if not last < number <= LAST_NUMBER:
        raise Conflict(f"version {number} of model {name!r} cannot be given; the next free number is {last + 1}")
    connection.execute(sa.update(MODELS).where(MODELS.c.name == name).values(last_version=number))
    connection.execute(
        sa.insert(VERSIONS).values(
            name=name,
            version=number,
            state=str(State.UPLOADED),
            digest=upload.digest,
            size_bytes=upload.size_bytes,
            manifest_sha256=upload.manifest_sha256,
            tensors_sha256=upload.tensors_sha256,
            blob=blob,
            uploaded_by=by,
            uploaded_at=at,
            changed_by=by,
            changed_at=at,
            description={},
        )
    )
    return version_record(version_row(connection, name, number))


def _last_version(connection: sa.Connection, name: str, at: str) -> int:
    """Return the highest version number of the model, creating the model if it does not exist."""
    try:
        return int(model_row(connection, name)["last_version"])
    except NotFound:
        connection.execute(sa.insert(MODELS).values(name=name, created_at=at, last_version=0))
        return 0
