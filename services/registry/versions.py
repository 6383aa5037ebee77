"""Changes of versions, each inside a write transaction: publication of an upload, activation, rollback and deletion."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa

from services.errors import Conflict, NotFound, Rejected, StillActive
from services.registry.folder import StagedUpload
from services.registry.records import (
    ACTIVATABLE,
    ACTIVATIONS,
    MODELS,
    VERSIONS,
    Change,
    State,
    VersionRecord,
    activation_steps,
    change_state,
    model_row,
    now,
    set_active,
    version_record,
    version_row,
)

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
    """Check the caller's name, which is stored with a change.

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
        wanted: required version number; None takes the next number.

    Raises:
        Conflict: if the number was already used, or is above `LAST_NUMBER`.
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


Reached = Callable[[str], None]
"""Callback that receives the name of each completed step of a change."""


def check_activatable(record: VersionRecord) -> None:
    """Check that a version can be activated.

    Raises:
        Conflict: if its state does not permit activation.
    """
    if record.state not in ACTIVATABLE:
        why = f" ({record.reason})" if record.state is State.REJECTED else ""
        raise Conflict(
            f"version {record.version} of model {record.name!r} is {record.state}{why}; only one that is"
            f" {' or '.join(ACTIVATABLE)} can be activated"
        )


def activate(
    connection: sa.Connection, name: str, version: int, expected: int | None, by: str, reached: Reached
) -> Change:
    """Activate a version in place of `expected`.

    Raises:
        NotFound: if the model or the version does not exist.
        Conflict: if another version than `expected` is active, or the version is not activatable.
    """
    before = _active_as_expected(connection, name, expected)
    check_activatable(version_record(version_row(connection, name, version)))
    at = now()
    if before is not None:
        change_state(connection, name, before, State.RETIRED, by, at)
        reached("earlier version retired")
    change_state(connection, name, version, State.ACTIVE, by, at, reason=None)
    reached("version marked active")
    steps = activation_steps(connection, name)
    step = steps[-1][0] + 1 if steps else 1
    connection.execute(sa.insert(ACTIVATIONS).values(name=name, step=step, version=version))
    set_active(connection, name, version)
    reached("model points to version")
    return _change(connection, "activate", name, version, by=by, at=at, active_before=before, active_after=version)


def rollback(
    connection: sa.Connection, name: str, expected: int | None, by: str, reason: str | None, reached: Reached
) -> Change:
    """Activate the previously active version again.

    Args:
        expected: version that must be active; None accepts any.

    Raises:
        NotFound: if the model does not exist.
        Conflict: if there is no earlier version, or another version than `expected` is active.
    """
    before = model_row(connection, name)["active"]
    if expected is not None:
        _active_as_expected(connection, name, expected)
    steps = activation_steps(connection, name)
    kept = list(steps)
    while kept and kept[-1][1] == before:
        kept.pop()
    if before is None or not kept:
        raise Conflict(f"model {name!r} has no version that was active before {before or 'any'}; activate one instead")
    at, target = now(), kept[-1][1]
    change_state(connection, name, before, State.RETIRED, by, at, reason=reason)
    reached("active version retired")
    change_state(connection, name, target, State.ACTIVE, by, at, reason=None)
    connection.execute(sa.delete(ACTIVATIONS).where(ACTIVATIONS.c.name == name, ACTIVATIONS.c.step > kept[-1][0]))
    reached("activations taken back")
    set_active(connection, name, target)
    facts = {"by": by, "at": at, "active_before": before, "active_after": target, "why": reason}
    return _change(connection, "rollback", name, target, **facts)


def delete(connection: sa.Connection, name: str, version: int, by: str) -> Change:
    """Delete a version's row and its activations.

    Raises:
        NotFound: if the version does not exist.
        StillActive: if the version is active.
    """
    active = model_row(connection, name)["active"]
    facts = {"by": by, "at": now(), "active_before": active, "active_after": active}
    change = _change(connection, "delete", name, version, **facts)
    if version == active:
        raise StillActive(f"version {version} of model {name!r} is active; activate another one before it is deleted")
    of_version = ACTIVATIONS.c.name == name, ACTIVATIONS.c.version == version
    connection.execute(sa.delete(ACTIVATIONS).where(*of_version))
    connection.execute(sa.delete(VERSIONS).where(VERSIONS.c.name == name, VERSIONS.c.version == version))
    return change


def _change(connection: sa.Connection, action: str, name: str, version: int, **facts: Any) -> Change:
    """Return the change record with the version's current row.

    Raises:
        NotFound: if the version does not exist.
    """
    return Change(**vars(version_record(version_row(connection, name, version))), action=action, **facts)


def _active_as_expected(connection: sa.Connection, name: str, expected: int | None) -> int | None:
    active: int | None = model_row(connection, name)["active"]
    if active != expected:
        raise Conflict(
            f"model {name!r} has {_version_in_words(active)} active, not {_version_in_words(expected)} as expected; look again and decide anew"
        )
    return active


def _version_in_words(version: int | None) -> str:
    return "no version" if version is None else f"version {version}"
