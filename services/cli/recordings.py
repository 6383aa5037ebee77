"""Implementation of the commands for recordings: `intrasplat validate`, `poses` and `synthesize`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import typer

from gsplat_core.errors import InvalidInput, RecordingInvalid
from gsplat_core.io.recordings import open_recording, synthesize, validate_recording
from gsplat_core.io.recordings.calibration import POSES_FILE, write_poses
from gsplat_core.io.recordings.recording import FileRecording
from gsplat_core.io.recordings.synthetic.random_scene import draw_scene
from gsplat_core.io.recordings.synthetic.scene import CLEAR, Extras
from gsplat_core.poses.focal_length import FocalLength, trajectory_without_calibration, with_focal_length
from gsplat_core.poses.odometry import Trajectory, trajectory_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import RELATIVE_DISTANCE, Frame
from operators.applications.session import Progress
from operators.errors import OutputError
from operators.output_folder import check_file_path, check_folder_path
from operators.storage import storage_errors
from services.cli.options import SynthesizeOptions
from services.cli.terminal import BAD_INPUT, OK, InterruptRequest, ProgressPrinter, printable


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


MOSTLY = 0.75
"""Share of the image motion that the estimated camera motion must explain. Below it, the endoscope is reported as
probably static."""
OFF = 0.002
"""Median reprojection error, as a share of the focal length, above which it is attributed to tissue motion instead of
tracking noise."""


def poses_command(recording: Path, out: Path, max_frames: int | None, *, overwrite: bool, as_json: bool) -> int:
    """Estimate the poses (without calibration also the focal length), write the poses and print their reliability."""
    if out.suffix != ".npy":
        raise OutputError(f"{out} does not end in .npy; give a name that does, such as {POSES_FILE}")
    check_file_path(out, [recording], overwrite=overwrite, into_recording=out.name == POSES_FILE)
    opened = open_recording(recording, max_frames=max_frames)
    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as show:

        def read() -> Iterator[Frame]:
            for done, frame in enumerate(opened, start=1):
                if interrupt():
                    raise KeyboardInterrupt
                show(Progress("follow", done, opened.frame_count))
                yield frame

        try:
            focal = None
            if opened.camera_is_assumed:
                found, focal = trajectory_without_calibration(read, opened.camera)
            else:
                found = trajectory_of(read(), opened.camera)
        except InvalidInput as error:  # raised only for pictures and cameras, which come from the recording
            raise RecordingInvalid(f"{recording}: {error}") from error
    with storage_errors(out.parent):
        write_poses(out, found.poses, overwrite=overwrite)
    _say(found, focal, opened, out, as_json)
    return OK


def _about_focal_length(focal: FocalLength | None, camera: Camera) -> str:
    """Describe how well the pictures determine an uncalibrated focal length."""
    assumed_px = float(camera.K[0, 0])
    if focal is None:
        return f"too few points could be followed far enough to determine the focal length; the poses use the assumed {assumed_px:.4g} px"
    low_px, high_px = focal.range_px
    if not focal.known:
        return (
            f"the pictures do not determine the focal length: tried values from {low_px:.4g} to {high_px:.4g} px fit almost equally well. The poses use"
            f" the assumed {assumed_px:.4g} px. An error of it scales distances along the viewing direction, relative to those across it"
        )
    K = with_focal_length(camera, round(focal.best_px, 1)).K
    stated = {
        "width": camera.width_px,
        "height": camera.height_px,
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
    }
    return (
        f"the focal length was found in the pictures: {focal.best_px:.4g} px fits best, and values from {low_px:.4g} to {high_px:.4g} px fit almost equally well. The poses use"
        f' {focal.best_px:.4g} px; the recording is read with {assumed_px:.4g} px until its recording.json has "camera": {json.dumps(stated)}'
    )


def _about_breathing(found: Trajectory, focal_px: float) -> list[str]:
    if found.breathing is not None:
        frequencies = " and ".join(f"{hz:.2f}" for hz in found.breathing.frequencies_hz)
        share = found.breathing.uncertain / max(found.path, 1e-9)
        return [
            f"the tissue moves by itself, {frequencies} times a second, and this motion was separated from the scope's trajectory; up to {share:.1%} of the trajectory may still be tissue motion"
        ]
    if found.error_px > OFF * focal_px:
        return [
            f"points are off by {found.error_px:.2g} px: the tissue moves by itself. Its common motion is contained in the poses. To separate breathing from the scope's trajectory,"
            " the recording has to show one and a half breaths, better five, and the scope must not swing nearly as fast itself"
        ]
    return []


def _say(found: Trajectory, focal: FocalLength | None, recording: FileRecording, out: Path, as_json: bool) -> None:
    notes = [
        f"lengths have no scale: the first frame's tissue is taken to be {RELATIVE_DISTANCE:g} away",
        *recording.notes,
    ]
    if recording.camera_is_assumed:
        notes.append(_about_focal_length(focal, recording.camera))
    if found.explained < MOSTLY:
        notes.append(
            f"the scope's motion explains only {found.explained:.0%} of the motion of the pictures: it may be at rest in front of moving tissue"
        )
    notes += _about_breathing(found, float(recording.camera.K[0, 0]))
    if found.lost:
        notes.append(
            f"{len(found.lost)} frames could not be placed and have the pose of the frame before, from frame {found.lost[0]} on"
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
        "breathing_hz": [round(hz, 3) for hz in found.breathing.frequencies_hz] if found.breathing else [],
        "uncertain": round(found.breathing.uncertain / max(found.path, 1e-9), 4) if found.breathing else None,
        "focal_px": round(focal.best_px if focal and focal.known else float(recording.camera.K[0, 0]), 2),
        "focal_px_from": "pictures"
        if focal and focal.known
        else "assumed"
        if recording.camera_is_assumed
        else "calibration",
        "focal_px_range": [round(end, 1) for end in focal.range_px] if focal else [],
    }
    if as_json:
        typer.echo(json.dumps({**facts, "notes": notes}, indent=2))
        return
    width = max(map(len, facts))
    for name, value in facts.items():
        typer.echo(f"{name:{width}}  {value if value not in ([], None) else '-'}")
    for note in notes:
        typer.echo(f"note: {printable(note)}")


def synthesize_command(out: Path, options: SynthesizeOptions, *, as_json: bool) -> int:
    """Write a synthetic recording and print its path. An interrupt leaves an existing recording unchanged."""
    extras = Extras(
        scene=options.scene,
        third=options.third,
        flow=options.flow,
        tracks=options.tracks,
        behind=options.behind,
        depth_noise_mm=options.depth_noise,
    )
    drawn = None
    if options.random:
        drawn = draw_scene(
            options.seed,
            scene=options.scene,
            moving=options.moving_camera,
            stereo=options.stereo,
            distorted=False if options.flow else None,
            smoke=options.smoke,
            exposure=options.exposure_changes,
            breathing_ratio=options.breathing_ratio,
            rate_wander=options.rate_wander,
            scope_path=options.scope_path,
        )
        extras = replace(extras, scope_path=options.scope_path if options.scope_path == "seeded" else CLEAR.scope_path)
    else:
        given: dict[str, Any] = {
            "smoke": options.smoke,
            "exposure_changes": options.exposure_changes,
            "breathing_ratio": options.breathing_ratio,
            "rate_wander": options.rate_wander,
            "scope_path": options.scope_path,
        }
        extras = replace(extras, **{name: value for name, value in given.items() if value is not None})
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
                stereo=options.stereo is not False,
                extras=extras,
                drawn=drawn,
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
