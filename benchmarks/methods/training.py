"""Offline training with the losses and renderers beside alpha blending, by the plain command.

    python benchmarks/methods/training.py --device cuda --full

Runs `intrasplat reconstruct` on `cutting`, `heart` and two random synthetic recordings of a stereo scope: alpha, with
the losses ray_depth and normal_consistency, with flow in addition, and as weighted sum. All runs have the same number
of steps. The time of a step is measured afterwards, in training of one eye on the first frames.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import Any

import log
import torch

from gsplat_core.io.recordings import open_recording
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor

ROOT = Path(__file__).resolve().parents[2]
SURFACE = "ray_depth,normal_consistency"
VARIANTS = {
    "alpha": (),
    "alpha + ray depth, normals": ("--losses", SURFACE),
    "alpha + ray depth, normals, flow": ("--losses", f"{SURFACE},flow"),
    "weighted sum": ("--renderer", "weighted_sum"),
}
TIMED_FRAMES, FIRST_TIMED, LAST_TIMED = 8, 100, 300
"""Number of frames, and first and last step, of the measurement of a step's time."""
KEPT = {
    "heldout_db": "quality.heldout.psnr_tissue_db",
    "neighbours_mean_db": "quality.baselines.heldout_neighbour_mean_db",
    "training_db": "quality.training.psnr_tissue_db",
}
"""Figures and their places in the report of the command."""
GEOMETRY = {
    "depth_rmse_share": "geometry.depth.rmse_share",
    "plane_rmse_share": "geometry.depth.plane_rmse_share",
    "normals_mean_deg": "geometry.normals.mean_deg",
    "points_mean_mm": "geometry.tracking.model.mean_mm",
    "points_still_mean_mm": "geometry.tracking.still.mean_mm",
    "error": "error",
}
"""Figures and their places in the result of the evaluation."""


def recordings(folder: Path, seeds: int, frames: int) -> dict[str, Path]:
    """Return the recordings by name; the synthetic ones are made in `folder`."""
    real = Path(os.environ.get("INTRASPLAT_RECORDINGS", ROOT.parent / "shared" / "recordings"))
    made = {"cutting": real / "cutting", "heart": real / "heart" / "left.mp4"}
    for seed in range(1, seeds + 1):
        path = made[f"synthetic, seed {seed}"] = folder / f"synthetic{seed}"
        words = ["synthesize", "--out", str(path), "--tracks", "--frames", str(frames), "--seed", str(seed)]
        subprocess.run([sys.executable, "-m", "services.cli", *words], check=True, capture_output=True)
    return made


def at(report: dict[str, Any], path: str) -> Any:
    """Return the value at a dotted path, or None."""
    value: Any = report
    for key in path.split("."):
        value = value.get(key) if isinstance(value, dict) else None
    return value


def command(*words: str) -> dict[str, Any]:
    """Run a command of the program and return its JSON, or its error."""
    done = subprocess.run(
        [sys.executable, "-m", "services.cli", *words, "--json"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return {"error": lines[-1] if lines else f"exit code {done.returncode}"}
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def train(path: Path, variant: tuple[str, ...], device: str, steps: int, options: tuple[str, ...]) -> dict[str, Any]:
    """Train a model and return its figures, with those of its geometry where the recording has the truth."""
    with tempfile.TemporaryDirectory() as folder:
        out = f"{folder}/run"
        start = time.perf_counter()
        words = ["reconstruct", str(path), "--out", out, "--device", device, "--steps", str(steps)]
        report = command(*words, *options, *variant)
        if "error" in report:
            return report
        figures: dict[str, Any] = {name: at(report, path) for name, path in KEPT.items()}
        figures["wall_s"] = round(time.perf_counter() - start, 1)
        if (path / "tracks.npy").exists():
            evaluated = command("evaluate", out, str(path), "--protocol", "geometry", "--device", device)
            figures |= {name: at(evaluated, path) for name, path in GEOMETRY.items()}
    return figures


def step_ms(path: Path, variant: tuple[str, ...], device: str) -> float:
    """Return the mean time of a training step of one eye in milliseconds."""
    chosen = dict(zip(variant[::2], variant[1::2], strict=True))
    losses = tuple(filter(None, chosen.get("--losses", "").split(",")))
    config = replace(ReconstructorConfig.offline(), losses=losses, renderer=chosen.get("--renderer", "alpha"))
    recording = open_recording(path, max_frames=TIMED_FRAMES)
    times: dict[int, float] = {}

    def after(step: int, loss: torch.Tensor) -> None:
        if step in (FIRST_TIMED, LAST_TIMED):
            loss.item()  # waits for the device
            times[step] = time.perf_counter()

    Reconstructor(config, recording.camera, device=device).fit(list(recording), LAST_TIMED + 1, after)
    return round(1e3 * (times[LAST_TIMED] - times[FIRST_TIMED]) / (LAST_TIMED - FIRST_TIMED), 3)


def main() -> None:
    """Measure and log."""
    parser = log.options((__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=0, help="0 for 2,000 with --full, otherwise 100")
    parser.add_argument("--seeds", type=int, default=2, help="synthetic recordings")
    parser.add_argument("--together", type=int, default=1, help="runs at a time; times are then not comparable")
    chosen = parser.parse_args()
    steps = chosen.steps or (2000 if chosen.full else 100)
    options = () if chosen.full else ("--scale", "0.25", "--max-frames", "16")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(chosen.together) as pool:
        found = recordings(Path(folder), chosen.seeds, 60 if chosen.full else 16)
        runs = {
            (name, variant): pool.submit(train, path, words, chosen.device, steps, options)
            for name, path in found.items()
            for variant, words in VARIANTS.items()
        }
        wait(runs.values())  # before times are measured
        figures: dict[str, Any] = {name: {} for name in found}
        for (name, variant), run in runs.items():
            figures[name][variant] = run.result() | {"step_ms": step_ms(found[name], VARIANTS[variant], chosen.device)}
            print(name, variant, figures[name][variant], flush=True)
    log.write("training", chosen, {"steps": steps, "together": chosen.together, **figures})


if __name__ == "__main__":
    main()
