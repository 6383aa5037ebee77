"""`intrasplat synthesize`."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from gsplat_core.io.recordings import open_recording, synthesize
from operators.applications.progress import Progress
from operators.output_paths import check_folder_path
from operators.storage import storage_errors
from services.cli.exit_codes import OK
from services.cli.interrupt import InterruptRequest
from services.cli.progress import ProgressPrinter


def synthesize_command(
    out: Path, frames: int, width_px: int, height_px: int, fps: float, seed: int, moving_camera: bool, *, as_json: bool
) -> int:
    """Write a synthetic recording and print where it is. An interrupt leaves what was there before."""
    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as show:

        def progress(done: int, total: int) -> None:
            if interrupt():
                raise KeyboardInterrupt
            show(Progress("synthesize", done, total))

        with storage_errors(out):
            check_folder_path(out)
            synthesize(
                out,
                frames=frames,
                width_px=width_px,
                height_px=height_px,
                fps=fps,
                seed=seed,
                camera="moving" if moving_camera else "fixed",
                progress=progress,
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
