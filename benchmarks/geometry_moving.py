"""Depth of rendered tissue that breathes, beats and is pulled by a tool, before a moving scope whose poses are given: each frame's depth map against the
truth, without a model in between.

    python benchmarks/geometry_moving.py [--frames 150] [--fps 30] [--width 320] [--height 256] [--seeds 0 1 2 3]

One JSON line a seed: the frequencies that were found (of each window), doubts, relative errors (root mean square over all tissue of all frames, the
same where depth is believed, the share that is believed, the median of the absolute value, after one scale for all frames), and processor seconds.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import numpy as np

from gsplat_core.geometry.depth_map import BELIEVED
from gsplat_core.geometry.moving_tissue import MovingTissue
from gsplat_core.io.recordings.synthetic.rendered import Asked, render_recording


def measured(asked: Asked) -> dict[str, Any]:
    """One recording's figures."""
    recording = render_recording(asked)
    frames = [frame.with_fields(depth=None, depth_origin=None) for frame in recording]
    began = time.process_time()
    tissue = MovingTissue(frames, [recording.camera_at(frame.seq) for frame in frames])
    found_s = time.process_time() - began
    relative, believed = [], []
    for number, frame in enumerate(recording):
        found = tissue.depth_of(number)
        assert frame.depth is not None
        assert frame.mask is not None
        if found.doubt is None:
            relative.append((found.depth / frame.depth)[frame.mask != 0])
            believed.append(found.confidence[frame.mask != 0] >= BELIEVED)
    figures: dict[str, Any] = {
        "seed": asked.seed,
        "frames": asked.frames,
        "fps": asked.fps,
        "frequencies_hz": [[round(hz, 3) for hz in each] for each in tissue.frequencies_hz],
        "doubts": tissue.doubts,
        "finding_s": round(found_s, 1),
        "each_frame_s": round((time.process_time() - began - found_s) / len(frames), 3),
    }
    if relative:
        ratio, sure = np.concatenate(relative), np.concatenate(believed)
        figures |= {
            "frames_with_depth": len(relative),
            "rms_percent": percent(np.sqrt(np.mean((ratio - 1) ** 2))),
            "median_percent": percent(np.median(np.abs(ratio - 1))),
            "scaled_rms_percent": percent(np.sqrt(np.mean((ratio / np.median(ratio) - 1) ** 2))),
            "believed_percent": percent(sure.mean()),
        }
        if sure.any():
            figures["believed_rms_percent"] = percent(np.sqrt(np.mean((ratio[sure] - 1) ** 2)))
    return figures


def percent(share: float) -> float:
    return round(100 * float(share), 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=256)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    asked = parser.parse_args()
    for seed in asked.seeds:
        wanted = Asked(asked.frames, asked.width, asked.height, fps=asked.fps, seed=seed, camera="moving")
        print(json.dumps(measured(wanted)), flush=True)


if __name__ == "__main__":
    main()
