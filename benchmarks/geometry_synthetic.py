"""Measure the 3D accuracy of reconstructions of synthetic recordings, for each kind of missing input.

One line per case:
* depth: RMS error relative to the median depth, before and after one scale, next to the level plane and the best-fit plane of each frame; mean angle of normals,
  next to both planes;
* third: PSNR in a third camera that training never sees, before and after one scale, next to the left picture and the shifted left picture;
* points: median error of tracked tissue points in mm, before and after one scale, next to no motion; the same in px;
* shares of the picture changes explained by motion, colour and size; trajectory error after similarity, relative to the path.

`--json` prints all figures. Training gets a copy of the recording without the inputs that the case lacks.

    fixed       one eye at rest, pictures and tool masks alone
    stereo      both eyes at rest
    poses       one moving eye with given poses
    no-poses    one moving eye, with poses estimated as by `intrasplat poses`
    depth       one eye at rest, with depth

Usage: python benchmarks/geometry_synthetic.py [CASE...] [--scene open|colon] [--steps 400 | --replay 10] [--frames 36] [--width 160] [--height 128]
       [--depth CHOICE] [--device cuda] [--work FOLDER] [--depth-noise MM] [--smoke S] [--exposure-changes] [--json]
On two CPU cores a case takes one to three minutes with these defaults. On a GPU: --device cuda --width 640 --height 512 --steps 3000.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from gsplat_core.evaluation.geometry import Geometry
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.calibration import POSES_FILE, write_poses
from gsplat_core.io.recordings.synthetic.scene import Extras
from gsplat_core.io.recordings.truth import open_truth
from gsplat_core.poses.odometry import trajectory_of
from operators.applications.evaluate import SeenFromAnywhere, measure_geometry
from operators.applications.reconstruct import reconstruct
from operators.applications.replay import ReplaySettings, replay


@dataclass(frozen=True)
class Case:
    """Inputs of training in addition to pictures, tool masks and intrinsics."""

    camera: str
    stereo: bool = False
    poses: bool = False
    depth: bool = False


CASES = {
    "fixed": Case("fixed"),
    "stereo": Case("fixed", stereo=True),
    "poses": Case("moving", poses=True),
    "no-poses": Case("moving"),
    "depth": Case("fixed", depth=True),
}


def main() -> int:
    arguments = parsed()
    work = arguments.work or Path(tempfile.mkdtemp(prefix="geometry-"))
    try:
        if not arguments.json:
            print(HEADER)
        for name in arguments.cases or CASES:
            geometry, seconds = measured(name, CASES[name], arguments, work)
            if arguments.json:
                print(json.dumps({"case": name, "train_s": round(seconds, 1), **asdict(geometry)}), flush=True)
            else:
                print(line(name, geometry, seconds), flush=True)
    finally:
        if arguments.work is None:
            shutil.rmtree(work)
    return 0


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", choices=[[], *CASES])
    parser.add_argument("--scene", default="open", choices=["open", "colon"])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument(
        "--replay", type=int, metavar="N", help="frame by frame, with N steps each, in place of --steps over all frames"
    )
    parser.add_argument("--frames", type=int, default=36)
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--height", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--depth", default="auto", help="depth source as in replay and reconstruct; light needs one fixed eye"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--work", type=Path, help="folder in which recordings and runs are kept and reused")
    parser.add_argument("--depth-noise", type=float, default=0.0)
    parser.add_argument("--smoke", type=float, default=0.0)
    parser.add_argument("--exposure-changes", action="store_true")
    parser.add_argument("--json", action="store_true")
    return parser.parse_args()


def measured(name: str, case: Case, arguments: argparse.Namespace, work: Path) -> tuple[Geometry, float]:
    """Train on the inputs of the case and evaluate with the full ground truth; returns the evaluation and the training time in s."""
    whole = recording_of(case, arguments, work)
    given = work / f"{name}-given"
    copy_of(whole, given, case)
    begun = time.perf_counter()
    if case.camera == "moving" and not case.poses:
        blind = open_recording(given)
        write_poses(given / POSES_FILE, trajectory_of(blind, blind.camera).poses)
    settings = ReplaySettings(
        given, work / f"{name}-run", device=arguments.device, sinks=(), seed=arguments.seed, depth=arguments.depth
    )
    if arguments.replay:
        replay(replace(settings, steps_per_frame=arguments.replay))
    else:
        reconstruct(settings, arguments.steps)
    seconds = time.perf_counter() - begun
    model = load_bundle(work / f"{name}-run" / "model").to(arguments.device)
    recording = open_recording(whole)
    truth = open_truth(whole, recording.frame_count)
    trained_on = open_recording(given)
    poses = work / f"{name}-poses.npy"
    write_poses(poses, np.stack([trained_on.camera_at(k).world_to_camera for k in range(recording.frame_count)]))
    pictures = SeenFromAnywhere(arguments.device)
    return measure_geometry(recording, recording.frame_count, recording.camera, model, pictures, truth, poses), seconds


def recording_of(case: Case, arguments: argparse.Namespace, work: Path) -> Path:
    """Return the recording with full ground truth, rendered once for all cases with the same camera."""
    extras = Extras(
        scene=arguments.scene,
        third=True,
        tracks=True,
        smoke=arguments.smoke,
        depth_noise_mm=arguments.depth_noise,
        exposure_changes=arguments.exposure_changes,
    )
    made = {
        "frames": arguments.frames,
        "width_px": arguments.width,
        "height_px": arguments.height,
        "fps": arguments.fps,
        "seed": arguments.seed,
        "camera": case.camera,
    }
    folder, note = work / f"recording-{case.camera}", work / f"recording-{case.camera}.json"
    wanted = json.dumps({**made, **asdict(extras)}, sort_keys=True)
    if not (folder.is_dir() and note.is_file() and note.read_text() == wanted):
        synthesize(folder, **made, extras=extras)
        note.write_text(wanted)
    return folder


def copy_of(whole: Path, given: Path, case: Case) -> None:
    """Copy the parts of a recording that the case gives to training."""
    if given.exists():
        shutil.rmtree(given)
    given.mkdir()
    folders = ["images", "masks", *(["images_right"] if case.stereo else []), *(["depth"] if case.depth else [])]
    for name in folders:
        shutil.copytree(whole / name, given / name)
    if case.poses:
        shutil.copy(whole / "poses_bounds.npy", given)
    description = json.loads((whole / "recording.json").read_text())
    kept = ["format", "version", "fps", "camera", "depth_unit_mm", *(["stereo_baseline_mm"] if case.stereo else [])]
    (given / "recording.json").write_text(json.dumps({key: description[key] for key in kept}))


HEADER = (
    f"{'case':<9} {'depth':>7} {'scaled':>7} {'level':>7} {'plane':>7} {'normals':>8} {'level':>6} {'plane':>6}  {'third':>6} {'scaled':>6} {'left':>6}"
    f" {'shifted':>7}  {'points':>7} {'scaled':>7} {'still':>7}   {'px':>5} {'still':>5}  {'motion':>6} {'colour':>6}"
    f" {'size':>6}  {'ATE':>6}  {'time':>5}"
)


def line(name: str, geometry: Geometry, seconds: float) -> str:
    """Return one case's figures: shares of the median depth, degrees, dB, median mm, median px, seconds."""
    depth, normals, tracking = geometry.depth, geometry.normals, geometry.tracking
    parts = geometry.parts
    assert depth is not None and normals is not None and tracking is not None and parts is not None
    way = "-" if geometry.trajectory is None else f"{geometry.trajectory.similarity_share:.2%}"
    third, scaled = (
        next(view for view in views if view.name == "third") for views in (geometry.views, geometry.scaled_views)
    )
    return (
        f"{name:<9} {depth.rmse_share:7.2%} {depth.scaled_rmse_share:7.2%} {depth.level_rmse_share:7.2%}"
        f" {depth.plane_rmse_share:7.2%}"
        f" {normals.mean_deg:7.1f}° {normals.level_mean_deg:5.1f}° {normals.plane_mean_deg:5.1f}°"
        f"  {third.model.psnr_tissue_db:6.2f} {scaled.model.psnr_tissue_db:6.2f} {third.left.psnr_tissue_db:6.2f}"
        f" {third.shifted.psnr_tissue_db:7.2f}"
        f"  {tracking.model.median_mm:7.2f} {tracking.scaled.median_mm:7.2f} {tracking.still.median_mm:7.2f}"
        f"   {tracking.model.median_px:5.2f} {tracking.still.median_px:5.2f}"
        f"  {parts.motion:6.1%} {parts.colour:6.1%} {parts.size:6.1%}  {way:>6}  {seconds:4.0f}s"
    )


if __name__ == "__main__":
    sys.exit(main())
