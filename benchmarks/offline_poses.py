"""Measure the durations in which `intrasplat reconstruct` estimates the path of a moving scope and depth by parallax from it.

    python benchmarks/offline_poses.py RECORDING... [--runs 3] [--scale 1]

RECORDING has no poses. The frames that are not held out are read, and their path and depth are estimated on all cores of the CPU. One JSON
line per run: frames, wall time of each estimate, and the number of frames with depth.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from run_facts import run_facts

from gsplat_core.depth.multiview import ParallaxDepth
from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.poses.odometry import camera_path_of


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.partition("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--scale", type=float, default=1.0)
    asked = parser.parse_args()
    facts = run_facts()
    for path in asked.recordings:
        recording = open_recording(path, scale=asked.scale)
        frames = [frame for frame in recording if not is_heldout(frame.seq)]
        for run in range(1, asked.runs + 1):
            began_s = time.perf_counter()
            try:
                found = camera_path_of(frames, recording.camera)
            except InvalidInput as error:
                parser.exit(1, f"{path}: {error}\n")
            path_s = time.perf_counter() - began_s
            posed = [frame.with_fields(pose=found.at(frame.time_s)) for frame in frames]
            cameras = [recording.camera.with_pose(found.at(frame.time_s)) for frame in frames]
            began_s = time.perf_counter()
            depth = ParallaxDepth().of_recording(posed, cameras)
            line = {
                "recording": path.parent.name if path.is_file() else path.name,
                "size": [recording.width_px, recording.height_px],
                "run": run,
                "frames": len(frames),
                "path_s": round(path_s, 2),
                "depth_s": round(time.perf_counter() - began_s, 2),
                "frames_with_depth": sum(frame.depth is not None for frame in depth.frames),
            }
            print(json.dumps(line | facts), flush=True)


if __name__ == "__main__":
    main()
