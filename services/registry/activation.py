"""Activation, rollback and deletion of versions, each inside a write transaction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import sqlalchemy as sa

from services.errors import Conflict, StillActive
from services.registry.records import ACTIVATABLE, Change, State, VersionRecord
from services.registry.rows import (
    activation_steps,
    change_state,
    model_row,
    now,
    set_active,
    version_record,
    version_row,
)
from services.registry.tables import ACTIVATIONS, VERSIONS

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
