"""Measure the host's time to create Gaussians for tissue that comes into view at the left edge of a picture.

    python benchmarks/new_tissue.py RECORDING [--enlarged 1 2] [--runs 3]

One thread. One JSON line per run and size: CPU time of the creation, median of 20 calls.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import torch
from run_facts import run_facts

from gsplat_core.io.recordings import open_recording
from gsplat_core.training import covering
from gsplat_core.training.config import ReconstructorConfig

CALLS = 20
NEW_SHARE = 0.04
"""Width of the new tissue, as a share of the picture's."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.partition("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument(
        "--enlarged", type=int, nargs="+", default=[1, 2], help="factors by which the picture is enlarged"
    )
    parser.add_argument("--runs", type=int, default=3)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    facts = run_facts()
    config = ReconstructorConfig()
    recording = open_recording(asked.recording)
    first = next(iter(recording))
    for run in range(1, asked.runs + 1):
        for enlarged in asked.enlarged:
            size = enlarged * recording.width_px, enlarged * recording.height_px
            frame = first.with_fields(
                image=cv2.resize(first.image, size), mask=None if first.mask is None else cv2.resize(first.mask, size)
            )
            spacing = covering.grid_spacing(size[0] * size[1], config.gaussians)
            grid, _ = covering.grid_of(size[1], size[0], spacing)
            wanted = grid[grid[:, 0] < NEW_SHARE * size[0]]
            column, row = np.meshgrid(np.arange(size[0]) / size[0], np.arange(size[1]) / size[1])
            depth_mm = (60 + 5 * column + 3 * np.sin(10 * row)).astype(np.float32)
            depth_mm[column < NEW_SHARE] = 0
            camera = recording.camera.resized(*size)
            seen = cast(Any, SimpleNamespace(camera=camera, image=torch.zeros(1)))
            times_ms = []
            for _ in range(CALLS):
                begin_ns = time.thread_time_ns()
                covering.gaussians_beside(wanted, frame, depth_mm, seen, config, len(wanted))
                times_ms.append((time.thread_time_ns() - begin_ns) / 1e6)
            line = {"run": run, "size": size, "gaussians": len(wanted), "cpu_ms": round(statistics.median(times_ms), 2)}
            print(json.dumps(line | facts), flush=True)


if __name__ == "__main__":
    main()
