"""`intrasplat synthesize`."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from gsplat_core.io.recordings import open_recording, synthesize
from operators.applications.progress import Progress
from operators.storage import storage_errors
from services.cli.exit_codes import OK
from services.cli.progress import ProgressPrinter


def synthesize_command(
    out: Path, frames: int, width_px: int, height_px: int, fps: float, seed: int, moving_camera: bool, *, as_json: bool
) -> int:
    """Write a synthetic recording and print where it is."""
    with ProgressPrinter(quiet=as_json) as progress, storage_errors(out.parent):
        synthesize(
            out,
            frames=frames,
            width_px=width_px,
            height_px=height_px,
            fps=fps,
            seed=seed,
            camera="moving" if moving_camera else "fixed",
            progress=lambda done, total: progress(Progress("synthesize", done, total)),
        )
    recording = open_recording(out)
    if as_json:
        facts = {
            "path": str(out),
            "frames": recording.frame_count,
            "width_px": recording.width_px,
            "height_px": recording.height_px,
            "fps": recording.fps,
            "digest": recording.digest,
        }
        typer.echo(json.dumps(facts, indent=2))
    else:
        typer.echo(str(out))
    return OK
