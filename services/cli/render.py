"""Implementation of `intrasplat render`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import typer

from operators.applications.render import render_model
from services.cli.exit_codes import INTERRUPTED, OK
from services.cli.interrupt import InterruptRequest
from services.cli.progress import ProgressPrinter


def render_command(model: Path, out: Path, fps: float, *, as_json: bool, **options: Any) -> int:
    """Render a model and print the path of the result. `options` are passed to `render_model`."""
    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as progress:
        frames = render_model(model, out, fps=fps, progress=progress, stop_requested=interrupt, **options)
    if as_json:
        typer.echo(
            json.dumps({"path": str(out), "frames": frames, "fps": fps, "interrupted": interrupt.requested}, indent=2)
        )
    else:
        typer.echo(str(out))
    return INTERRUPTED if interrupt.requested else OK
