"""Commands for recordings: validation and pose estimation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.options import JsonOption, RecordingArgument, path_option

PosesOutOption = Annotated[Path, path_option("--out", "The file: poses.npy, to be put beside the recording's images.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there already.")]


def add_to(app: typer.Typer) -> None:
    """Add these commands to the program."""
    app.command()(validate)
    app.command()(poses)


def validate(recording: RecordingArgument, json: JsonOption = False) -> int:
    """Read a recording completely and report its defects."""
    from services.cli.validate import validate_command

    return validate_command(recording, as_json=json)


def poses(
    recording: RecordingArgument,
    out: PosesOutOption,
    max_frames: Annotated[int | None, typer.Option(help="Read only so many frames.", show_default="all")] = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
) -> int:
    """Estimate the pose of a moving endoscope at each frame, from the pictures alone."""
    from services.cli.poses import poses_command

    return poses_command(recording, out, max_frames, overwrite=overwrite, as_json=json)
