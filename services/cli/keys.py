"""Implementation of `intrasplat keys`: API keys in a server's folder, with or without a running
server."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path

import typer

from gsplat_core.errors import UserError
from services.api.app import AUDIT_FILE, KEYS_FILE
from services.audit import AuditInUse, AuditLog, AuditUnwritable, Keeping
from services.auth.keys import ApiKey, KeyConflict, KeyStore, append_key_change
from services.auth.roles import Role
from services.cli.exit_codes import OK
from services.cli.tables import KEY_COLUMNS, table
from services.settings import ServiceSettings, load_settings
from services.settings.sections import NAME_PATTERN


class KeyRefused(UserError):
    """A key cannot be created or revoked."""


def keys_list_command(config: Path | None, data: Path | None, *, as_json: bool) -> int:
    """Print every key."""
    store = _store(config, data)
    used = store.last_used()
    rows = [
        {
            **{name: value for name, value in asdict(key).items() if name != "sha256"},
            "last_used_at": used.get(key.id),
            "expired": key.has_expired(),
        }
        for key in store.all()
    ]
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return OK
    for line in table(KEY_COLUMNS, rows):
        typer.echo(line)
    return OK


def keys_add_command(
    config: Path | None, data: Path | None, name: str, role: str, expires_days: float | None, streams: Sequence[str]
) -> int:
    """Create a key and print its token once to standard output."""
    _check_name(name, "a key")
    for stream in streams:
        _check_name(stream, "a stream")
    if role not in (Role.VIEWER, Role.OPERATOR, Role.ADMIN):
        raise KeyRefused(f"the role is {role!r:.60}; choose viewer, operator or admin")
    try:
        key, token = _store(config, data).create(
            name, Role(role), expires_at=expiry_in(expires_days), streams=list(streams) or None
        )
    except KeyConflict as error:
        raise KeyRefused(str(error)) from error
    _audited(config, data, "key.create", key)
    typer.echo(token)
    return OK


def expiry_in(days: float | None) -> datetime | None:
    """Return the time in `days` days, or None for None.

    Raises:
        KeyRefused: if the number is not positive or too large.
    """
    if days is None:
        return None
    try:
        if not days > 0:
            raise ValueError
        return datetime.now(UTC) + timedelta(days=days)
    except (ValueError, OverflowError) as error:
        raise KeyRefused(f"a key cannot expire in {days:g} days; give a number above 0, such as 90") from error


def _check_name(name: str, of: str) -> None:
    if not re.fullmatch(NAME_PATTERN, name):
        raise KeyRefused(f"{name!r:.60} is no name of {of}; use a-z, 0-9 and -, at most 40 of them")


def keys_revoke_command(config: Path | None, data: Path | None, key_id: str) -> int:
    """Revoke a key."""
    try:
        key = _store(config, data).revoke(key_id)
    except KeyError as error:
        raise KeyRefused(f"there is no key {key_id!r:.60}; `intrasplat keys list` shows them") from error
    except KeyConflict as error:
        raise KeyRefused(str(error)) from error
    _audited(config, data, "key.revoke", key)
    typer.echo(f"revoked {key.id} of {key.name}")
    return OK


def _audited(config: Path | None, data: Path | None, event: str, key: ApiKey) -> None:
    """Write the change to the audit log. A running server holds the log and writes the entry itself
    within seconds."""
    settings = _settings(config, data)
    keep = settings.audit
    with suppress(AuditInUse):
        audit = AuditLog(
            settings.data_dir / AUDIT_FILE, Keeping(keep.segment_bytes, keep.keep_segments, keep.keep_days)
        )
        try:
            append_key_change(audit, event, key)
        except AuditUnwritable as error:
            raise KeyRefused(f"the key was changed, but the audit log could not be written: {error}") from error
        finally:
            audit.close()


def _store(config: Path | None, data: Path | None) -> KeyStore:
    return KeyStore(_settings(config, data).data_dir / KEYS_FILE)


def _settings(config: Path | None, data: Path | None) -> ServiceSettings:
    return load_settings(config, {} if data is None else {"paths.data": json.dumps(str(data))})
