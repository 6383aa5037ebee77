"""Implementation of `intrasplat audit verify`."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import typer

from services.api.app import AUDIT_FILE
from services.audit import verify
from services.cli.exit_codes import BAD_INPUT, OK
from services.cli.streams import printable
from services.settings import SettingsInvalid, load_settings


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
