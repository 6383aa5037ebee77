"""Implementation of `intrasplat validate`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import typer

from gsplat_core.io.recordings import validate_recording
from services.cli.exit_codes import BAD_INPUT, OK
from services.cli.streams import printable


def validate_command(recording: Path, *, as_json: bool) -> int:
    """Print the properties and defects of a recording.

    Returns:
        The exit code; 2 if the recording cannot be used.
    """
    report = validate_recording(recording)
    if as_json:
        typer.echo(json.dumps({"ok": report.ok, **asdict(report)}, indent=2))
        return OK if report.ok else BAD_INPUT
    width = max((len(name) for name in report.facts), default=0)
    for name, value in report.facts.items():
        typer.echo(f"{name:{width}}  {_shown(value)}")
    for warning in report.warnings:
        typer.echo(f"warning: {printable(str(warning))}")
    for problem in report.problems:
        typer.echo(f"error: {printable(str(problem))}", err=True)
    if report.ok:
        typer.echo("the recording can be used")
    return OK if report.ok else BAD_INPUT


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_shown(part) for part in value)
    return "-" if value is None else printable(str(value))
