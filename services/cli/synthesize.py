"""Implementation of `intrasplat synthesize`."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.synthetic.extras import Extras
from operators.applications.progress import Progress
from operators.output_folder import check_folder_path
from operators.storage import storage_errors
from services.cli.exit_codes import OK
from services.cli.interrupt import InterruptRequest
from services.cli.options import SynthesizeOptions
from services.cli.progress import ProgressPrinter


def synthesize_command(out: Path, options: SynthesizeOptions, *, as_json: bool) -> int:
    """Write a synthetic recording and print its path. An interrupt leaves an existing recording
    unchanged."""
    extras = Extras(
        scene=options.scene,
        third=options.third,
        flow=options.flow,
        tracks=options.tracks,
        behind=options.behind,
        smoke=options.smoke,
        depth_noise_mm=options.depth_noise,
        exposure_changes=options.exposure_changes,
        breathing_ratio=options.breathing_ratio,
        rate_wander=options.rate_wander,
        scope_path=options.scope_path,
    )
    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as show:

        def progress(done: int, total: int) -> None:
            if interrupt():
                raise KeyboardInterrupt
            show(Progress("synthesize", done, total))

        with storage_errors(out):
            check_folder_path(out)
            synthesize(
                out,
                frames=options.frames,
                width_px=options.width,
                height_px=options.height,
                fps=options.fps,
                seed=options.seed,
                camera="moving" if options.moving_camera else "fixed",
                extras=extras,
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
