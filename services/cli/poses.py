"""`intrasplat poses`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import typer

from gsplat_core.errors import InvalidInput, RecordingInvalid
from gsplat_core.geometry.odometry import DISTANCE, Trajectory, trajectory_of
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.poses_file import write_poses
from gsplat_core.io.recordings.recording import FileRecording
from gsplat_core.scene.frames import Frame
from operators.applications.progress import Progress
from operators.errors import OutputError
from operators.storage import storage_errors
from services.cli.exit_codes import OK
from services.cli.interrupt import InterruptRequest
from services.cli.progress import ProgressPrinter
from services.cli.streams import printable

MOSTLY = 0.75
"""Share of the motion that the scope has to explain, or it is said that it may well stand still."""


def poses_command(recording: Path, out: Path, max_frames: int | None, *, overwrite: bool, as_json: bool) -> int:
    """Estimate the poses of a recording, write them, and say how far they are to be believed."""
    if not out.parent.is_dir():
        raise OutputError(f"there is no folder {out.parent} to write {out.name} into; make it first")
    if out.exists() and not (overwrite and out.is_file()):
        raise OutputError(f"{out} is there already; give another name, or --overwrite to replace it")
    opened = open_recording(recording, max_frames=max_frames)
    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as show:

        def frames() -> Iterator[Frame]:
            for done, frame in enumerate(opened, start=1):
                if interrupt():
                    raise KeyboardInterrupt
                show(Progress("follow", done, opened.frame_count))
                yield frame

        try:
            found = trajectory_of(frames(), opened.camera)
        except InvalidInput as error:  # all that it refuses are pictures and cameras, which are the recording's here
            raise RecordingInvalid(f"{recording}: {error}") from error
    with storage_errors(out.parent):
        write_poses(out, found.poses, overwrite=overwrite)
    _say(found, opened, out, as_json)
    return OK


def _say(found: Trajectory, recording: FileRecording, out: Path, as_json: bool) -> None:
    notes = [f"lengths have no scale: the first frame's tissue is taken to be {DISTANCE:g} away", *recording.notes]
    if found.explained < MOSTLY:
        notes.append(
            f"the scope's motion explains only {found.explained:.0%} of how the pictures move: it may stand still before tissue that moves"
        )
    if found.lost:
        notes.append(
            f"{len(found.lost)} frames could not be placed and stand where the one before stands, from frame {found.lost[0]} on"
        )
    facts = {
        "path": str(out),
        "frames": len(found.poses),
        "points": len(found.points),
        "way": round(found.path, 4),
        "error_px": round(found.error_px, 4),
        "error_px_of_a_still_scope": round(found.still_error_px, 4),
        "explained": round(found.explained, 4),
        "not_placed": list(found.lost),
    }
    if as_json:
        typer.echo(json.dumps({**facts, "notes": notes}, indent=2))
        return
    width = max(map(len, facts))
    for name, value in facts.items():
        typer.echo(f"{name:{width}}  {value if value != [] else '-'}")
    for note in notes:
        typer.echo(f"note: {printable(note)}")
