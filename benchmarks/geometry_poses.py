"""Compare poses estimated from pictures with the recorded ones.

    python benchmarks/geometry_poses.py RECORDING... [--synthetic FRAMES] [--fps 15] [--seeds 0 1] [--rigid] [--way WAY] [--causal] [--assume F] [--depth]
        [--breathing-ratio 2] [--rate-wander 0.15] [--scope-path seeded]

One JSON line per recording: ATE after the best similarity, relative to the length of the recorded path; errors in pixels; processor seconds; for breathing tissue
the frequencies and the stated uncertainty.

--synthetic N   adds a rendered recording of N frames, 320x256: a moving scope in front of tissue that breathes and is pulled; with --rigid, tissue at rest
--way back      the scope moves sideways until it sees nothing of the first view, and returns; --way circle: around a circle of that width. Adds the error of
                the last pose, which equals the first one
--causal        estimates frame by frame, as live and `replay` do, on one thread; adds processor milliseconds per frame
--depth         adds the depth error of breathing tissue (`moving_tissue`) with these poses, for every fifth frame, after one scale
--assume 0.9    ignores the calibration, assumes this focal length in units of the longer side, and prints the estimate next to the true one
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import torch
from geometry_moving import add_breathing_options, asked_breathing, breathing_facts
from run_facts import run_facts

from gsplat_core.evaluation.geometry import evaluate_trajectory
from gsplat_core.experimental.breathing_depth import MovingTissue
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.io.recordings.synthetic.tissue import Tissue, Tug
from gsplat_core.poses.focal_length import trajectory_without_calibration, with_focal_length
from gsplat_core.poses.live_odometry import LiveOdometry
from gsplat_core.poses.odometry import Trajectory, trajectory_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

FARTHEST_MM = 110.0
"""Largest distance from the start on paths that return, in mm. A picture shows 82 mm of the tissue."""


def measured(
    name: str, frames: Sequence[Frame], camera: Camera, assumed: float | None
) -> tuple[dict[str, Any], Trajectory]:
    """Return one recording's figures. `assumed`: focal length per longer side, or None for the camera's own."""
    began_s = time.process_time()
    focal, side_px = None, max(camera.width_px, camera.height_px)
    if assumed is None:
        found = trajectory_of(frames, camera)
    else:
        found, focal = trajectory_without_calibration(lambda: frames, with_focal_length(camera, assumed * side_px))
    figures: dict[str, Any] = {
        "recording": name,
        "frames": len(frames),
        "s": round(time.process_time() - began_s, 1),
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
    if found.breathing is not None:
        figures |= {
            "breathing_hz": [round(hz, 3) for hz in found.breathing.frequencies_hz],
            "uncertain_percent": round(100 * found.breathing.uncertain / found.path, 3),
        }
    return figures, found


def measured_causally(name: str, frames: Sequence[Frame], camera: Camera) -> dict[str, Any]:
    """Return one recording's figures, with each frame placed by the earlier ones."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    odometry, poses, spent_ms = LiveOdometry(camera, measured=False), [], []
    for frame in frames:
        began_s = time.thread_time()
        poses.append(odometry.place(frame))
        spent_ms.append(1e3 * (time.thread_time() - began_s))
    figures: dict[str, Any] = {
        "recording": name,
        "frames": len(frames),
        "ms_a_frame": round(float(np.mean(spent_ms)), 1),
        "ms_p95": round(float(np.percentile(spent_ms, 95)), 1),
        "explained": round(odometry.explained, 3),
        "not_placed": odometry.not_placed,
        "begun": odometry.begun,
        "key_frames": len(odometry.map.keys),
    }
    given = [frame.pose for frame in frames if frame.pose is not None]
    if len(given) == len(frames):
        errors = evaluate_trajectory(np.stack(poses), np.stack(given))
        if errors is not None:
            last, first = (-each[:3, :3].T @ each[:3, 3] for each in (poses[-1], poses[0]))
            figures |= {"ate_percent": round(100 * errors.similarity_share, 3), "way": round(errors.path, 4)}
            if np.allclose(given[-1], given[0]):
                figures["drift_percent"] = round(
                    100 * errors.scale * float(np.linalg.norm(last - first)) / errors.path, 3
                )
    return figures


def depth_of(frames: Sequence[Frame], camera: Camera, found: Trajectory) -> dict[str, Any]:
    """Errors of depth with the poses that were found, after one scale."""
    blind = [frame.with_fields(depth=None, depth_origin=None, pose=None) for frame in frames]
    tissue = MovingTissue(blind, [camera.with_pose(pose) for pose in found.poses])
    ratios = []
    for number in range(0, len(frames), 5):
        depth, true, mask = tissue.depth_of(number), frames[number].depth, frames[number].mask
        if depth.doubt is None and true is not None and mask is not None:
            ratios.append((depth.depth / true)[mask != 0])
    if not ratios:
        return {"depth_doubts": tissue.doubts}
    ratio = np.concatenate(ratios)
    relative = ratio / np.median(ratio) - 1
    return {
        "depth_rms_percent": round(100 * float(np.sqrt(np.mean(relative**2))), 2),
        "depth_median_percent": round(100 * float(np.median(np.abs(relative))), 2),
    }


def synthetic(asked: RenderSettings, rigid: bool, way: str = "sway") -> Any:
    """A rendered recording with a moving scope."""
    moving, still, swaying = Tissue.points, Tug((0.0, 0.0), (0.0,) * 3), SyntheticScene._left_at
    if rigid:
        Tissue.points = lambda self, u, v, time_s, tug: moving(self, u, v, 0.0, still)  # type: ignore[method-assign]
    if way != "sway":
        SyntheticScene._left_at = lambda self, time_s: on_way(  # type: ignore[method-assign]
            self.camera, way, time_s * asked.fps / (asked.frames - 1)
        )
    try:
        return render_recording(asked)
    finally:
        Tissue.points, SyntheticScene._left_at = moving, swaying  # type: ignore[method-assign]


def on_way(camera: Camera, way: str, share: float) -> Camera:
    """A camera that looks straight ahead, on its way away and back to where it began."""
    turn = 2 * np.pi * share
    across = 0.0 if way == "back" else FARTHEST_MM / 2 * np.sin(turn)
    centre = np.array([FARTHEST_MM / 2 * (1 - np.cos(turn)), across, 3 * np.sin(2 * turn)])
    pose = np.eye(4)
    pose[:3, 3] = -centre
    return camera.with_pose(pose)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*")
    parser.add_argument("--synthetic", type=int, default=0)
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--depth", action="store_true")
    parser.add_argument("--rigid", action="store_true")
    parser.add_argument("--way", choices=["sway", "back", "circle"], default="sway")
    parser.add_argument("--causal", action="store_true")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--assume", type=float)
    add_breathing_options(parser)
    arguments = parser.parse_args()
    for path in arguments.recordings:
        recording = open_recording(path, scale=arguments.scale)
        show(recording.name, list(recording), recording.camera, arguments)
    for seed in arguments.seeds if arguments.synthetic else []:
        extras = asked_breathing(arguments)
        asked = RenderSettings(
            arguments.synthetic, 320, 256, fps=arguments.fps, seed=seed, camera="moving", extras=extras
        )
        rendered = synthetic(asked, arguments.rigid, arguments.way)
        name = f"synthetic {seed}, {arguments.way}{', rigid' * arguments.rigid}"
        show(name, list(rendered), rendered.camera, arguments, breathing_facts(extras))


def show(
    name: str,
    frames: Sequence[Frame],
    camera: Camera,
    arguments: argparse.Namespace,
    conditions: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Print a recording's figures; conditions: of how it was rendered."""
    if arguments.causal:
        print(json.dumps(measured_causally(name, frames, camera) | conditions | run_facts()), flush=True)
        return
    figures, found = measured(name, frames, camera, arguments.assume)
    if arguments.depth:
        figures |= depth_of(frames, camera, found)
    print(json.dumps(figures | conditions | run_facts()), flush=True)


if __name__ == "__main__":
    main()
