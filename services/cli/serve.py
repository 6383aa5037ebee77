"""Implementation of the commands for a server, its data and its streams: `intrasplat serve`, `schema`, `keys`, `audit`, `backup`, `restore` and `igtl`."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import typer

from gsplat_core.errors import InvalidSetting, UserError
from services.api.app import assembled, new_app
from services.api.observability import log_to_stderr, say_start
from services.api.server import bind, certificate_of, serve
from services.api.service import bind_probe, probe_socket_is_there
from services.audit import AuditInUse, AuditLog, AuditUnwritable, Keeping, verify
from services.audit.log import AUDIT_FILE
from services.auth.keys import KEYS_FILE, ApiKey, KeyConflict, KeyStore, Role, append_key_change
from services.backup import Backup, check_backup, make_backup, refuse_unfinished_restore, restore_backup
from services.cli.options import check_host
from services.cli.terminal import BAD_INPUT, KEY_COLUMNS, OK, InterruptRequest, printable, table
from services.display import KINDS
from services.errors import SettingsInvalid
from services.openigtlink import MessageServer, StreamMessages, folder_of, send
from services.private_files import keep_files_private, make_state_private
from services.settings import NAME_PATTERN, ServiceSettings, load_settings
from services.supervisor.gpu_sharing import check_mps


def serve_command(
    config: Path | None, host: str | None, port: int | None, data: Path | None, setting: Sequence[str]
) -> int:
    """Run the server until SIGTERM or SIGINT."""
    keep_files_private()
    named = {"server.host": host, "server.port": port, "paths.data": data}
    flags = {name: json.dumps(str(value)) for name, value in named.items() if value is not None}
    settings = load_settings(config, {**_assigned(setting), **flags})
    log_to_stderr(settings.log)
    listener = bind(settings)  # a failure must come before any file or process is created
    if settings.gpu.mps:
        check_mps()
    refuse_unfinished_restore(settings)
    make_state_private(settings.data_dir, settings.uploaded_recordings.folder, settings.jobs.folder)
    parts = assembled(settings)
    parts = replace(parts, checks={**parts.checks, "runtime": lambda: probe_socket_is_there(settings)})
    certificate = certificate_of(settings, parts.events)
    if certificate is not None:
        parts = replace(
            parts,
            background=[*parts.background, certificate.watched],
            checks={**parts.checks, "certificate": certificate.check},
            collectors=[*parts.collectors, certificate],
        )
    app = new_app(settings, parts)
    probes = bind_probe(settings)
    serve(app, settings, listener, lambda address: _say(address, settings), certificate, probes)
    return OK


def schema_command() -> int:
    """Print the JSON schema of the settings file."""
    typer.echo(json.dumps(ServiceSettings.model_json_schema(), indent=2))
    return OK


def _assigned(setting: Sequence[str]) -> dict[str, str]:
    flags = {}
    for each in setting:
        name, equals, value = each.partition("=")
        if not equals or not name:
            raise SettingsInvalid(f"--set {each!r:.80} has no value; write --set section.key=value")
        flags[name] = value
    return flags


def _say(address: str, settings: ServiceSettings) -> None:
    say_start(f"IntraSplat is on {address}/", f"the administrator's key is in {settings.admin_key_file}")


def igtl_command(
    stream: str, config: Path | None, runtime: Path | None, *, kind: str, host: str, port: int, name: str | None,
    spacing_mm: float, plaintext: bool,
) -> int:  # fmt: skip
    """Send a stream's pictures to OpenIGTLink clients until interrupted."""
    if kind not in KINDS:
        raise InvalidSetting(f"there is no picture {kind!r:.60}; choose {', '.join(KINDS)}")
    check_host(host, plaintext, "OpenIGTLink has no keys and sends unencrypted pictures to every client")
    folder = folder_of(runtime or load_settings(config, {}).runtime_dir, stream)
    messages = StreamMessages(name or stream[:13], spacing_mm)
    server = MessageServer(host, port)
    try:
        with InterruptRequest() as interrupt:
            print(f"OpenIGTLink server on {server.address[0]}:{server.address[1]}", file=sys.stderr, flush=True)  # noqa: T201
            counts = send(folder.endpoint(kind), messages, server, interrupt)
    finally:
        server.close()
    typer.echo(json.dumps(counts))
    return OK


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
    """Write the change to the audit log. A running server holds the log and writes the entry itself within seconds."""
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


def audit_verify_command(file: Path | None, config: Path | None, head: str | None, *, as_json: bool) -> int:
    """Verify the hash chain of an audit log.

    Returns:
        The exit code; 2 if the log was altered.
    """
    if head is not None and not re.fullmatch("[0-9a-f]{64}", head):
        raise SettingsInvalid(f"--head is {head!r:.80}, no digest; give the 64 hexadecimal digits of an entry")
    path = file or load_settings(config).data_dir / AUDIT_FILE
    try:
        verdict = verify(path, head)
    except (OSError, ValueError) as error:
        raise SettingsInvalid(
            f"{path}: {getattr(error, 'strerror', None) or error}; give the audit log's path"
        ) from error
    if not verdict.intact:
        typer.echo(
            f"error: {printable(str(path))} is NOT as it was written: {len(verdict.findings)} findings on standard output; compare it with a backup",
            err=True,
        )
    if as_json:
        typer.echo(json.dumps({"intact": verdict.intact, **asdict(verdict)}, indent=2))
        return OK if verdict.intact else BAD_INPUT
    for finding in verdict.findings:
        typer.echo(f"{finding.file or path.name}, line {finding.line}: {finding.what}")
    if verdict.removed:
        typer.echo(f"{verdict.removed} older entries were removed by the service, as its settings say")
    if verdict.cut_by_a_crash:
        typer.echo("the last line has no end: the service stopped while it wrote; its next start takes the line off")
    kept = "intact" if verdict.intact else "NOT as it was written"
    typer.echo(f"{verdict.entries} entries, {kept}; the newest has the digest {verdict.head.digest}")
    return OK if verdict.intact else BAD_INPUT


def backup_command(target: Path, config: Path | None, data: Path | None, *, as_json: bool) -> int:
    """Back up a service, running or not.

    Returns:
        The exit code; 2 if files of rows were missing or the audit log is inconsistent.
    """
    keep_files_private()
    made = make_backup(_settings(config, data), target)
    _print_backup(f"{target}: ", made, as_json)
    if not made.missing and made.audit == "intact":
        return OK
    wrong = (
        f"files of {len(made.missing)} entries were missing"
        if made.missing
        else "the audit log was NOT as it was written"
    )
    typer.echo(
        f"error: {wrong} in the service already; the backup was made as far as possible, keep an older one too",
        err=True,
    )
    return BAD_INPUT


def restore_command(source: Path, config: Path | None, data: Path | None, *, check: bool, as_json: bool) -> int:
    """Check a backup and, unless `check` is set, restore it into the service's empty folders."""
    keep_files_private()
    if check:
        found = check_backup(source)
        _print_backup(f"{source} is whole: ", found, as_json)
        return OK
    settings = _settings(config, data)
    found = restore_backup(settings, source)
    _print_backup(f"restored into {settings.data_dir}: ", found, as_json)
    return OK


def _print_backup(begin: str, backup: Backup, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(asdict(backup), indent=2))
        return
    typer.echo(f"{begin}{backup.files} files, {backup.size_bytes / 2**20:.1f} MiB, made {backup.made_at}")
    for each in backup.missing:
        typer.echo(f"not in it: the files of {each}, which were missing in the service")
    if backup.audit != "intact":
        typer.echo(f"the audit log is NOT as it was written: {backup.audit}")
    for each in backup.elsewhere:
        typer.echo(f"not in it: {each}")
