"""Poses from pictures alone, against those that a recording came with.

    python benchmarks/geometry_poses.py RECORDING... [--synthetic FRAMES] [--rigid] [--assume F]

One JSON line a recording: ATE (root mean square of the distance between both ways after the best similarity) as a share of the given way, errors in
pixels, and seconds. `--synthetic 150` adds a rendered recording of so many frames at 15 frames/s, 320x256, with a moving scope before tissue that
breathes and is pulled; `--rigid` the same before tissue that stands still. `--assume 0.9` does without the calibration: the focal length is assumed to be 0.9 of the longer
side, and what the pictures tell of it stands beside the true one, in the same unit.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsplat_core.evaluation.trajectory import evaluate_trajectory
from gsplat_core.geometry.focal_length import trajectory_without_calibration, with_focal_length
from gsplat_core.geometry.odometry import trajectory_of
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.synthetic.rendered import Asked, render_recording
from gsplat_core.io.recordings.synthetic.tissue import Tissue, Tug
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame


def measured(name: str, frames: Sequence[Frame], camera: Camera, assumed: float | None) -> dict[str, Any]:
    """One recording's figures. assumed: focal length in units of the longer side; None: the camera's own."""
    began_s = time.monotonic()
    focal, side_px = None, max(camera.width_px, camera.height_px)
    if assumed is None:
        found = trajectory_of(frames, camera)
    else:
        found, focal = trajectory_without_calibration(lambda: frames, with_focal_length(camera, assumed * side_px))
    figures: dict[str, Any] = {
        "recording": name,
        "frames": len(frames),
        "s": round(time.monotonic() - began_s, 1),
        "error_px": round(found.error_px, 3),
        "still_error_px": round(found.still_error_px, 3),
        "explained": round(found.explained, 3),
        "not_placed": len(found.lost),
    }
    if assumed is not None:
        figures |= {
            "focal": round(float(camera.K[0, 0]) / side_px, 3),
            "assumed": assumed,
            "known": focal is not None and focal.known,
        }
    if focal is not None:
        figures |= {
            "best": round(focal.best_px / side_px, 3),
            "range": [round(end / side_px, 3) for end in focal.range_px],
        }
    given = [frame.pose for frame in frames if frame.pose is not None]
    if len(given) == len(frames) and np.ptp(np.stack(given), axis=0).max() > 1e-9:
        errors = evaluate_trajectory(found.poses, np.stack(given))
        if errors is not None:
            figures |= {"ate_percent": round(100 * errors.similarity_share, 3), "way": round(errors.path, 4)}
    return figures


def synthetic(count: int, rigid: bool) -> Any:
    """A rendered recording with a moving scope."""
    asked, moving, still = Asked(count, 320, 256, fps=15, camera="moving"), Tissue.points, Tug((0.0, 0.0), (0.0,) * 3)
    if not rigid:
        return render_recording(asked)
    Tissue.points = lambda self, u, v, time_s, tug: moving(self, u, v, 0.0, still)  # type: ignore[method-assign]
    try:
        return render_recording(asked)
    finally:
        Tissue.points = moving  # type: ignore[method-assign]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*")
    parser.add_argument("--synthetic", type=int, default=0)
    parser.add_argument("--rigid", action="store_true")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--assume", type=float)
    arguments = parser.parse_args()
    for path in arguments.recordings:
        recording = open_recording(path, scale=arguments.scale)
        print(json.dumps(measured(recording.name, list(recording), recording.camera, arguments.assume)), flush=True)
    if arguments.synthetic:
        rendered = synthetic(arguments.synthetic, arguments.rigid)
        name = "synthetic, rigid" if arguments.rigid else "synthetic"
        print(json.dumps(measured(name, list(rendered), rendered.camera, arguments.assume)), flush=True)


if __name__ == "__main__":
    main()
