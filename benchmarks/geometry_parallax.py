"""Measure depth of a moving scope with poses at structure-from-motion points, for the estimator and for the model trained on it.

    python benchmarks/geometry_parallax.py RECORDING [--scale 0.5] [--depth none parallax]

RECORDING is a folder with poses and `sfm_points.npz`. One JSON line per choice of `--depth`: PSNR and depth of each displayed frame, depth of the final model at all
frames, and the processor time of depth estimation per frame.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sparse_points import SparseDepthErrors, SparseDepthSums, SparsePoints

from gsplat_core.depth.maps import DepthFinder
from gsplat_core.io.recordings import FileRecording, open_recording
from gsplat_core.rendering.rasterization import render
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.replay import ReplaySettings


def rounded(errors: SparseDepthErrors | None) -> dict[str, float] | None:
    return None if errors is None else {name: round(value, 4) for name, value in asdict(errors).items()}


def measured(recording: FileRecording, points: SparsePoints, choice: str) -> dict[str, Any]:
    config = ReplaySettings(Path("."), Path(".")).reconstructor_config(recording.width_px * recording.height_px)
    learning, finder = Reconstructor(config, recording.camera), DepthFinder(choice, recording.camera)
    estimated, shown, last = (SparseDepthSums(points) for _ in range(3))
    psnr_db, finding_s, frames = [], 0.0, list(recording)
    for frame in frames:
        camera = recording.camera_at(frame.seq)
        began = time.process_time()
        given = finder.with_depth(frame)
        finding_s += time.process_time() - began
        if given.depth is not None:
            estimated.add(frame.seq, given.depth, camera)
        learning.observe(given)
        output = render(learning.snapshot().at(frame.time_s), camera, depth=True)
        shown.add(frame.seq, output.depth.numpy(), camera)
        psnr_db.append(psnr_tissue_db(output.image.numpy(), frame.image / 255.0, frame.mask))
    model = learning.snapshot()
    for frame in frames:
        camera = recording.camera_at(frame.seq)
        last.add(frame.seq, render(model.at(frame.time_s), camera, depth=True).depth.numpy(), camera)
    return {
        "recording": recording.name,
        "size": [recording.width_px, recording.height_px],
        "depth": choice,
        "psnr_db": round(sum(psnr_db) / len(psnr_db), 2),
        "finding_cpu_ms_a_frame": round(1000 * finding_s / len(frames), 1),
        "doubts": finder.doubts.counted(),
        "estimator": rounded(estimated.errors()),
        "shown": rounded(shown.errors()),
        "last_model": rounded(last.errors()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--depth", nargs="+", default=["none", "parallax"])
    asked = parser.parse_args()
    recording = open_recording(asked.recording, scale=asked.scale)
    points = SparsePoints.read(asked.recording / "sfm_points.npz")
    for choice in asked.depth:
        print(json.dumps(measured(recording, points, choice)), flush=True)


if __name__ == "__main__":
    main()
