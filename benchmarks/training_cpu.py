"""Measure one fused training step on the CPU: deform, render, loss, backward, Adam.

    python benchmarks/training_cpu.py                # 30,000 Gaussians at 640x512, both fields; limit: 300 ms
    python benchmarks/training_cpu.py --threads 1 --repetitions 10

Prints one JSON object per line: median and best of the repetitions in milliseconds, for the basis field and for a small HexPlane
field (16 channels, one level), with and without SSIM and depth, and then the parts of a step of the basis field. The scene starts
from a seeded picture of a wavy surface some 60 mm away; each step is at another time.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from gsplat_core.deformation import BasisField, BasisRates, DeformationField, HexPlaneField
from gsplat_core.ops.native import instruction_set
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.optimiser import FusedAdam
from gsplat_core.training.steps.photometric import LossWeights, loss_and_gradients
from gsplat_core.training.steps.step import TrainingStep

WINDOW_S = (0.0, 6.0)
FOCAL_PX = 560.0


def tissue_frame(width: int, height: int) -> Frame:
    """Return a frame of a textured wavy surface with depth, and a tool in one corner."""
    y, x = np.mgrid[:height, :width]
    depth = (60 + 12 * np.sin(x / 90) * np.cos(y / 70)).astype(np.float32)
    waves = [np.sin(0.11 * x + 0.05 * y), np.sin(0.07 * x - 0.13 * y), np.sin(0.05 * x + 0.09 * y)]
    noise = np.random.default_rng(0).normal(0, 12, (height, width, 3))
    image = np.clip(127 + 70 * np.stack(waves, -1) + noise, 0, 255).astype(np.uint8)
    mask = np.ones((height, width), np.uint8)
    mask[: height // 3, : width // 4] = 0
    return Frame(0, 0, image, depth=depth, mask=mask)


def milliseconds(work: Callable[[float], object], repetitions: int, warm_up: int = 3) -> dict[str, float]:
    """Return median and minimum over the repetitions in ms, each at another time within the window."""
    taken = []
    times_s = itertools.islice(itertools.cycle(np.linspace(0.5, 5.5, 37).tolist()), repetitions + warm_up)
    for at_s in times_s:
        start = time.perf_counter()
        work(at_s)
        taken.append((time.perf_counter() - start) * 1e3)
    counted = taken[warm_up:]
    return {"median_ms": round(statistics.median(counted), 2), "best_ms": round(min(counted), 2)}


def new_field(kind: str, gaussians: Gaussians) -> DeformationField:
    """Return the measured field."""
    if kind == "basis":
        return BasisField(gaussians.count, WINDOW_S, spacing_s=ReconstructorConfig().motion_spacing_s)
    return HexPlaneField(gaussians, WINDOW_S, channels=16, resolution=(64, 64, 64, 25), levels=(1,), width=64, depth=2)


def seen_at(observation: Observation, time_s: float) -> Observation:
    """Return the observation at another time."""
    fields = {name: getattr(observation, name) for name in ("seq", "camera", "image", "mask", "depth")}
    return Observation(time_s=time_s, **fields)


def parts(
    step: TrainingStep, observation: Observation, config: ReconstructorConfig
) -> dict[str, Callable[[float], Any]]:
    """Time each part of a step of the basis field."""
    field = step.field
    assert isinstance(field, BasisField)
    gaussians, _ = step.copy()
    weights = LossWeights(config.ssim_weight, config.depth_weight, config.squared_error)
    deformed = step.at(1.0)
    gradients = loss_and_gradients(deformed, observation, weights).gradients
    deltas = torch.cat([gradients["means"], gradients["quats"], gradients["log_scales"], gradients["sh"][:, 0]], 1)
    adam = FusedAdam(gaussians.tensors(), dict.fromkeys(gaussians.tensors(), 0.0))
    still = BasisRates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return {
        "deform": step.at,
        "render_only": lambda _: render(deformed, observation.camera, depth=config.depth_weight > 0),
        "render_loss_backward": lambda _: loss_and_gradients(deformed, observation, weights),
        "field_backward_adam": lambda at_s: field.adam_step(at_s, deltas, still),
        "gaussians_adam": lambda _: adam.step(gaussians.tensors(), gradients),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=30_000)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=512)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repetitions", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    camera = Camera.from_focal(FOCAL_PX * options.width / 640, options.width, options.height)
    frame = tissue_frame(options.width, options.height)
    observation = Observation.of(frame, camera)
    start = gaussians_from_frame(frame, camera, options.gaussians, sh_degree=0, default_depth_mm=60.0)
    machine = {
        "processor": platform.processor() or platform.machine(),
        "instructions": instruction_set(),
        "threads": options.threads,
        "torch": torch.__version__,
        "gaussians": start.count,
        "size_px": [options.width, options.height],
    }

    def report(case: str, field: str, figures: dict[str, float]) -> None:
        print(json.dumps({"case": case, "field": field, **figures} | machine), flush=True)

    losses = {"l1": (0.0, 0.0), "l1_depth": (0.0, 0.02), "l1_ssim_depth": (0.2, 0.02)}
    for kind in ("basis", "hexplane"):
        for loss, (ssim_weight, depth_weight) in losses.items():
            config = ReconstructorConfig(ssim_weight=ssim_weight, depth_weight=depth_weight)
            step = TrainingStep(start.clone(), new_field(kind, start), config, camera)
            work = lambda at_s, step=step: step(seen_at(observation, at_s))
            report(f"step_{loss}", kind, milliseconds(work, options.repetitions))
    config = ReconstructorConfig()
    step = TrainingStep(start.clone(), new_field("basis", start), config, camera)
    for part, work in parts(step, observation, config).items():
        report(f"part_{part}", "basis", milliseconds(work, options.repetitions))


if __name__ == "__main__":
    main()
