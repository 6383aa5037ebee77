"""Measure depth maps of rendered tissue that breathes, beats and is pulled by a tool, seen by a moving scope with given poses, without a model.

    python benchmarks/geometry_moving.py [--frames 150] [--fps 30] [--width 320] [--height 256] [--seeds 0 1 2 3]
        [--breathing-ratio 2] [--rate-wander 0.15] [--scope-path seeded]

One JSON line per seed: estimated frequencies (per window), doubts, relative depth errors, and processor seconds. Errors: RMS over all tissue of all frames; RMS where depth
is trusted, with that share; median absolute error; RMS after one scale for all frames; RMS of each frame's level plane and best-fit plane
(`gsplat_core.evaluation.depth`). The last three options are those of `intrasplat synthesize`.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import numpy as np
from run_facts import run_facts

from gsplat_core.evaluation.depth import MOST_DEPTH_PIXELS, flat_depths, pixels_to_compare
from gsplat_core.experimental.breathing_depth import MovingTissue
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.io.recordings.synthetic.scene import CLEAR, Extras
from gsplat_core.scene.frames import BELIEVED


def measured(asked: RenderSettings) -> dict[str, Any]:
    """Return the figures of one recording."""
    recording = render_recording(asked)
    frames = [frame.with_fields(depth=None, depth_origin=None) for frame in recording]
    began = time.process_time()
    tissue = MovingTissue(frames, [recording.camera_at(frame.seq) for frame in frames])
    found_s = time.process_time() - began
    relative, believed, flat = [], [], []
    for number, frame in enumerate(recording):
        found = tissue.depth_of(number)
        assert frame.depth is not None
        assert frame.mask is not None
        if found.doubt is None:
            relative.append((found.depth / frame.depth)[frame.mask != 0])
            believed.append(found.confidence[frame.mask != 0] >= BELIEVED)
            rays, true = pixels_to_compare(recording.camera, frame.mask != 0, MOST_DEPTH_PIXELS, frame.depth)
            planes = flat_depths(rays, true)
            assert planes is not None
            flat.append(np.stack([planes.level, planes.plane]) / true - 1)
    figures: dict[str, Any] = {
        "seed": asked.seed,
        "frames": asked.frames,
        "fps": asked.fps,
        **breathing_facts(asked.extras),
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
            **{
                f"{name}_percent": percent(np.sqrt(np.mean(np.square(off))))
                for name, off in zip(("level", "plane"), np.concatenate(flat, axis=1), strict=True)
            },
        }
        if sure.any():
            figures["believed_rms_percent"] = percent(np.sqrt(np.mean((ratio[sure] - 1) ** 2)))
    return figures


def add_breathing_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a rendered recording's breathing and scope path; defaults as those of `intrasplat synthesize`."""
    parser.add_argument("--breathing-ratio", type=float, default=CLEAR.breathing_ratio)
    parser.add_argument("--rate-wander", type=float, default=CLEAR.rate_wander)
    parser.add_argument("--scope-path", choices=["usual", "seeded"], default=CLEAR.scope_path)


def asked_breathing(arguments: argparse.Namespace) -> Extras:
    """Return the arguments of `synthesize` for the parsed breathing options."""
    return Extras(
        breathing_ratio=arguments.breathing_ratio, rate_wander=arguments.rate_wander, scope_path=arguments.scope_path
    )


def breathing_facts(extras: Extras) -> dict[str, Any]:
    """Return the breathing conditions for a log line."""
    return {name: getattr(extras, name) for name in ("breathing_ratio", "rate_wander", "scope_path")}


def percent(share: float) -> float:
    return round(100 * float(share), 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=256)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    add_breathing_options(parser)
    asked = parser.parse_args()
    for seed in asked.seeds:
        wanted = RenderSettings(
            asked.frames, asked.width, asked.height, fps=asked.fps, seed=seed, camera="moving",
            extras=asked_breathing(asked),
        )  # fmt: skip
        print(json.dumps(measured(wanted) | run_facts()), flush=True)


if __name__ == "__main__":
    main()
