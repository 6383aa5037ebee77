"""Implementation of `intrasplat backup` and `intrasplat restore`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import typer

from services.backup import Backup, check_backup, make_backup, restore_backup
from services.cli.exit_codes import BAD_INPUT, OK
from services.private_files import keep_files_private
from services.settings import ServiceSettings, load_settings


def backup_command(target: Path, config: Path | None, data: Path | None, *, as_json: bool) -> int:
    """Back up a service, running or not.

    Returns:
        The exit code; 2 if files of rows were missing or the audit log is inconsistent.
    """
    keep_files_private()
    made = make_backup(_settings(config, data), target)
    _say(f"{target}: ", made, as_json)
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
        _say(f"{source} is whole: ", found, as_json)
        return OK
    settings = _settings(config, data)
    found = restore_backup(settings, source)
    _say(f"restored into {settings.data_dir}: ", found, as_json)
    return OK


def _say(begin: str, backup: Backup, as_json: bool) -> None:
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


def _settings(config: Path | None, data: Path | None) -> ServiceSettings:
    return load_settings(config, {} if data is None else {"paths.data": json.dumps(str(data))})
