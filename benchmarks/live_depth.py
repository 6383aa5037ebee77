"""Measure a live model's use of depth: without depth, with each frame, or some frames later for a subset of frames.

    python benchmarks/live_depth.py RECORDING [--depth stereo] [--late 0 3 10] [--every 3] [--steps 2] [--rehearsed 2] [--scale 0.5]

Steps are counted, not timed: live's settings for a CPU, `--steps` before a frame is shown and `--rehearsed` after it. With `--late 0` every frame is trained on with its
depth. Otherwise the depth of every `--every`-th frame is learned that many frames later. One JSON line each: PSNR of the displayed pictures, and depth error against the
recording's own `depth/`, which training does not get, or at the points of `sfm_points.npz` after one factor (medians over all frames and over the last third).
"""

from __future__ import annotations

import argparse
import json
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sparse_points import SparseDepthSums, SparsePoints

from gsplat_core.depth.maps import DepthFinder
from gsplat_core.io.recordings import FileRecording, open_recording
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.live_settings import LiveSettings

Arguments = argparse.Namespace


class DepthErrors:
    """Depth errors over all frames and over the last third."""

    def __init__(self, recording: FileRecording, points: SparsePoints | None) -> None:
        self._recording, self._points = recording, points
        self._sums = [SparseDepthSums(points) for _ in range(2)] if points is not None else []
        self._errors: list[float] = []

    def take(self, frame: Frame, depth: NDArray[np.float32]) -> None:
        """Add the error of the model's depth for a frame."""
        if self._points is not None:
            for sums in self._sums[: 1 + (3 * frame.seq >= 2 * self._recording.frame_count)]:
                sums.add(frame.seq, depth, self._recording.camera_at(frame.seq))
        elif frame.depth is not None:
            known = frame.depth > 0 if frame.mask is None else (frame.depth > 0) & (frame.mask > 0)
            self._errors.append(float(np.median(np.abs(depth[known] / frame.depth[known] - 1))))

    def stated(self) -> dict[str, float]:
        """Return the errors in percent."""
        if self._sums:
            found = [sums.errors() for sums in self._sums]
            pair = [one.median for one in found if one is not None]
        else:
            pair = [float(np.mean(each)) for each in (self._errors, self._errors[2 * len(self._errors) // 3 :])]
        return dict(zip(("error_pct", "error_last_third_pct"), (round(100 * value, 2) for value in pair), strict=False))


def run(asked: Arguments, recording: FileRecording, points: SparsePoints | None, late: int | None) -> dict[str, Any]:
    """Measure one run. `late`: delay of the depth in frames, or None for no depth."""
    settings = LiveSettings(source="", out=Path())
    config = settings.reconstructor_config(recording.width_px * recording.height_px)
    learning = Reconstructor(config, recording.camera, live=settings.chosen_training)
    finder = DepthFinder(asked.depth, recording.camera, has_time=True)
    errors, psnr_db, taken = DepthErrors(recording, points), [], 0
    under_way: deque[Frame] = deque()
    for frame in recording:
        bare = frame.with_fields(depth=None, depth_origin=None)
        seeks = late is not None and (late == 0 or frame.seq % asked.every == 0)
        found = finder.with_depth(bare) if seeks else bare
        learning.observe(found if late == 0 else bare, steps=asked.steps)
        output = render(learning.publish().as_model().at(frame.time_s), recording.camera_at(frame.seq), depth=True)
        psnr_db.append(psnr_tissue_db(output.image.numpy(), frame.image / 255.0, frame.mask))
        errors.take(frame, output.depth.numpy())
        if late and found.depth is not None:
            under_way.append(found)
        if late and under_way and under_way[0].seq + late <= frame.seq:
            taken += learning.take_depth(under_way.popleft())
        learning.grow(bare)
        learning.rehearse(asked.rehearsed)
    return {"late": late, "taken": taken, "psnr_db": round(float(np.mean(psnr_db)), 2), **errors.stated()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--depth", default="auto")
    parser.add_argument("--late", nargs="+", type=int, default=[0, 3, 10])
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--steps", type=int, default=2)
    parser.add_argument("--rehearsed", type=int, default=2)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--max-frames", type=int)
    asked = parser.parse_args()
    recording = open_recording(asked.recording, scale=asked.scale, max_frames=asked.max_frames)
    sparse = asked.recording / "sfm_points.npz"
    points = SparsePoints.read(sparse) if sparse.exists() else None
    for late in (None, *asked.late):
        print(json.dumps({"recording": recording.name, **run(asked, recording, points, late)}), flush=True)


if __name__ == "__main__":
    main()
