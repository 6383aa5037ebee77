"""Training of a static scene in COLMAP's format with each strategy, next to trivial baselines.

The scene comes from `colmap_scene.py`. Every training is a process of its own: `intrasplat train`. Baselines show the
training picture of the nearest camera, and the mean of all training pictures. gsplat's own trainer needs CUDA.

Figures per strategy: median and worst of three seeds.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import colmap_scene
import log
import numpy as np

from gsplat_core.io.recordings.colmap import read_colmap
from gsplat_core.training.metrics import frame_quality
from gsplat_core.training.static import TrainingPicture, read_pictures

SEEDS = (0, 1, 2)
STRATEGIES = ("adc", "mcmc")
SMALL = {"views": 32, "width_px": 160, "height_px": 120, "points": 1500}
LARGE = {"views": 120, "width_px": 640, "height_px": 480, "points": 20_000, "per_unit": 220}
"""Sizes of the scene for the CPU and for a GPU."""
STEPS, MAX_GAUSSIANS = {False: 600, True: 30_000}, {False: 4000, True: 200_000}
"""Steps, and the cap of mcmc, for the small and the large scene."""


def train(scene: Path, strategy: str, seed: int, chosen: Any) -> dict[str, Any]:
    """Train in a process of its own, and return its result with the processor time of the whole process."""
    with tempfile.TemporaryDirectory(prefix="static-") as folder:
        cap = ["--max-gaussians", str(MAX_GAUSSIANS[chosen.full])] if strategy == "mcmc" else []
        words = [
            "train",
            str(scene),
            "--out",
            f"{folder}/out",
            "--strategy",
            strategy,
            "--steps",
            str(chosen.steps),
            *cap,
        ]
        words += ["--seed", str(seed), "--device", chosen.device, "--json"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "services.cli", *words]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**json.loads(done.stdout), "processor_s": processor_s}


def summary(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return median and worst of the runs."""

    def both(value: Callable[[dict[str, Any]], float], worst: Callable[..., float], digits: int) -> list[float]:
        values = [value(run) for run in runs]
        return [round(statistics.median(values), digits), round(worst(values), digits)]

    return {
        "psnr_db": both(lambda run: run["heldout"]["psnr_db"], min, 2),
        "ssim": both(lambda run: run["heldout"]["ssim"], min, 4),
        "gaussians": both(lambda run: run["gaussians"], max, 0),
        "training_s": both(lambda run: run["training_s"], max, 1),
        "processor_s": both(lambda run: run["processor_s"], max, 1),
        "peak_mib": both(lambda run: (run["device_peak_bytes"] or run["peak_memory_bytes"]) / 2**20, max, 0),
    }


def baselines(scene: Path) -> dict[str, dict[str, float]]:
    """Return PSNR and SSIM of the nearest training picture and of the mean training picture, over held-out images."""
    read = read_colmap(scene)
    known, held_out = read_pictures(read, read.training()), read_pictures(read, read.held_out())
    mean = np.mean([each.image for each in known], 0).round().astype(np.uint8)
    shown = {"nearest training picture": lambda each: nearest(each, known).image, "mean picture": lambda _: mean}
    found = {}
    for name, picture in shown.items():
        scores = [frame_quality(0, picture(each), each.image) for each in held_out]
        psnr_db = float(np.mean([score.psnr_tissue_db for score in scores]))
        found[name] = {"psnr_db": round(psnr_db, 2), "ssim": round(float(np.mean([score.ssim for score in scores])), 4)}
    return found


def nearest(wanted: TrainingPicture, known: Sequence[TrainingPicture]) -> TrainingPicture:
    """Return the picture whose camera is nearest."""
    return min(known, key=lambda each: float(np.linalg.norm(each.camera.position - wanted.camera.position)))


def main() -> None:
    """Train and log."""
    parser = log.options(__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, help="steps of a training; 600, or 30,000 with --full")
    chosen = parser.parse_args()
    chosen.steps = chosen.steps or STEPS[chosen.full]
    size = LARGE if chosen.full else SMALL
    with tempfile.TemporaryDirectory(prefix="scene-") as folder:
        scene = Path(folder) / "scene"
        colmap_scene.write_scene(scene, **size)
        figures: dict[str, Any] = {"scene": size, "steps": chosen.steps, "baselines": baselines(scene)}
        figures["strategies"] = {
            name: summary([train(scene, name, seed, chosen) for seed in SEEDS]) for name in STRATEGIES
        }
    figures["seeds"] = len(SEEDS)
    log.write("static", chosen, figures, folder="gsplat")


if __name__ == "__main__":
    main()
