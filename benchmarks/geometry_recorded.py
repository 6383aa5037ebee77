"""Compare a model's depth with the recorded depth, for each depth source of training.

    python benchmarks/geometry_recorded.py RECORDING [--depth recorded light none] [--steps 2000] [--device cuda] [--scale 1]

One JSON line per choice, trained offline on all frames and frame by frame: RMS depth error relative to the median depth, before and after one scale, next to the level
plane (`level`) and the best-fit plane (`plane`) of each frame; median absolute error after that scale. Every third frame is compared where its recorded depth is
trusted (`measured_confidence`); `all_pixels` is the error after one scale over all pixels.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from gsplat_core.depth.maps import DepthFinder, measured_confidence
from gsplat_core.evaluation.depth import DepthShareSums
from gsplat_core.io.recordings import open_recording
from gsplat_core.models import Model
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.replay import ReplaySettings

EVERY = 3


def models(
    offline: bool, choice: str, frames: list[Frame], camera: Camera, asked: argparse.Namespace
) -> Iterator[Model]:
    """Yield each frame with the model that displays it."""
    settings = ReplaySettings(recording="", out=Path(), device=asked.device, depth=choice)
    config = settings.reconstructor_config(camera.width_px * camera.height_px, offline=offline)
    learning = Reconstructor(config, camera, device=asked.device)
    if offline:
        learning.fit(frames, asked.steps)
        yield from [learning.snapshot()] * len(frames)
        return
    for frame in frames:
        learning.observe(frame)
        yield learning.snapshot()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--depth", nargs="+", default=["recorded", "light", "none"])
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--scale", type=float, default=1.0)
    asked = parser.parse_args()
    recording = open_recording(asked.recording, scale=asked.scale)
    frames, camera = list(recording), recording.camera
    for choice in asked.depth:
        finder = DepthFinder(choice, camera, has_time=True)
        given = [finder.with_depth(frame) for frame in frames]
        for offline in (True, False):
            sums, of_all = DepthShareSums(), DepthShareSums()
            for frame, model in zip(frames, models(offline, choice, given, camera, asked), strict=True):
                if frame.seq % EVERY or frame.depth is None:
                    continue
                pose = camera if frame.pose is None else camera.with_pose(frame.pose)
                with torch.no_grad():
                    shown = render(model.at(frame.time_s), pose, depth=True).depth.cpu().numpy()
                known = np.isfinite(frame.depth) & (frame.depth > 0)
                known = known if frame.mask is None else known & (frame.mask > 0)
                of_all.add(camera, frame.depth, shown, known)
                sums.add(camera, frame.depth, shown, known & (measured_confidence(frame.depth) > 0))
            errors, everywhere = sums.errors, of_all.errors
            assert errors is not None and everywhere is not None, "the recording has no depth to compare with"
            figures = {
                "all_pixels": everywhere.scaled_rmse_share,
                "rmse": errors.rmse_share, "scaled": errors.scaled_rmse_share, "plane": errors.plane_rmse_share,
                "level": errors.level_rmse_share, "median": errors.median_share, "covered": errors.covered,
            }  # fmt: skip
            way = "offline" if offline else "frame by frame"
            print(
                json.dumps({"depth": choice, "trained": way} | {k: round(v, 4) for k, v in figures.items()}), flush=True
            )


if __name__ == "__main__":
    main()
