"""Implementation of `intrasplat train`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import typer

from operators.applications.static_scene import MODEL_FOLDER, SceneTraining, train_scene
from operators.output_folder import OutputFolder
from operators.settings import TrainOptions
from operators.storage import mebibytes
from services.cli.exit_codes import INTERRUPTED, OK
from services.cli.progress import ProgressPrinter
from services.cli.terminal import InterruptRequest, printable


def train_command(scene: Path, out: Path, options: TrainOptions, *, as_json: bool) -> int:
    """Train a scene, publish the results in `out` and print the scores.

    Returns:
        The exit code.
    """
    with InterruptRequest() as interrupt, OutputFolder(out, "train", [scene]) as output:
        try:
            with ProgressPrinter(quiet=as_json) as progress:
                result = train_scene(scene, options, output.path, progress=progress, stop_requested=interrupt)
        except KeyboardInterrupt:
            output.publish()
            raise
        output.publish()
    if as_json:
        typer.echo(json.dumps(asdict(result), indent=2))
    else:
        typer.echo("\n".join([*_lines(result), str(out / MODEL_FOLDER)]))
    return INTERRUPTED if interrupt.requested else OK


def _lines(result: SceneTraining) -> list[str]:
    rate = result.steps / result.training_s if result.training_s else 0.0
    lines = [
        f"{result.steps} steps on {result.training_images} images in {result.training_s:.1f} s ({rate:.1f} steps/s):"
        f" {result.gaussians} Gaussians, peak memory {mebibytes(result.device_peak_bytes or result.peak_memory_bytes)}"
    ]
    score = result.heldout
    if score is not None:
        lines.append(
            f"{len(score.images)} held-out images: PSNR {score.psnr_db:.2f} dB, SSIM {score.ssim:.4f}, worst {score.worst_db:.2f} dB"
            f" ({printable(score.worst)})"
        )
    return lines
