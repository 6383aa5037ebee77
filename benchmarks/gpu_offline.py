"""Measure offline reconstruction on held-out frames against training time, on an NVIDIA GPU.

    python benchmarks/gpu_offline.py RECORDING... [--device cuda] [--fields basis hexplane] [--seconds 15]
    python benchmarks/gpu_offline.py RECORDING --device cpu --scale 0.25 --steps 500
    python benchmarks/gpu_offline.py RECORDING --set smoothing=0 --set smoothing=2,motion_spacing_s=0.05

Calls `Reconstructor.fit` as `intrasplat reconstruct` does, with `ReconstructorConfig.offline` and the protocol's held-out frames. `--steps` is the number of optimiser
steps. `--seconds` derives it from a short run before. Each `--set` is a run with other values of `ReconstructorConfig`. One JSON line per evaluation:
seconds of training so far (without loading, kernel warm-up and evaluation), mean and worst tissue PSNR over the held-out frames and over as many training frames.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.replay import ReplaySettings

MOMENTS = (0.1, 0.25, 0.5, 0.75, 1.0)
"""Shares of the steps after which the model is evaluated."""
STRETCH_STEPS = 100
TRIAL_STRETCHES = 6


@dataclass
class Clock:
    """Stopwatch of training time that excludes evaluation."""

    device: torch.device
    total_s: float = 0.0
    _since: float = field(default_factory=time.perf_counter)

    def pause(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        self.total_s += time.perf_counter() - self._since

    def go_on(self) -> None:
        self._since = time.perf_counter()


def quality(learning: Reconstructor, frames: list[Frame], camera: Camera) -> tuple[float, float]:
    """Return mean and worst tissue PSNR of frames rendered to 8 bits."""
    model = learning.snapshot()
    values = []
    for frame in frames:
        seen = camera if frame.pose is None else camera.with_pose(frame.pose)
        image = render(model.at(frame.time_s), seen).image
        shown = (image.clamp(0, 1) * 255).round().to(torch.uint8)
        values.append(psnr_tissue_db(shown, frame.image, frame.mask))
    return sum(values) / len(values), min(values)


def changed(config: ReconstructorConfig, values: str) -> ReconstructorConfig:
    """Return settings changed by one `--set` value: name=value,…"""
    pairs = (one.split("=") for one in values.split(",") if one)
    return replace(config, **{name: json.loads(value) for name, value in pairs})


def split(frames: list[Frame]) -> tuple[list[Frame], list[Frame]]:
    """Split frames into training frames and held-out frames."""
    return [each for each in frames if not is_heldout(each.seq)], [each for each in frames if is_heldout(each.seq)]


def steps_within(
    seconds: float, frames: list[Frame], camera: Camera, config: ReconstructorConfig, device: torch.device
) -> int:
    """Return the number of steps that fit into `seconds`, start included, from a trial with the most Gaussians.

    Its fastest stretch counts: other work on the device slows a trial down, and never makes it faster.
    """
    trial = replace(config, gaussians=config.max_gaussians)
    learning, clock = Reconstructor(trial, camera, device=device), Clock(device)
    times_s: list[float] = []

    def after_step(step: int, loss: Tensor) -> None:
        if step % STRETCH_STEPS == 0:
            clock.pause()
            times_s.append(clock.total_s)
            clock.go_on()

    learning.fit(split(frames)[0], STRETCH_STEPS * TRIAL_STRETCHES, after_step)
    step_s = min(later - earlier for earlier, later in itertools.pairwise(times_s)) / STRETCH_STEPS
    start_s = times_s[0] - STRETCH_STEPS * step_s
    return max(1, round((seconds - start_s) / step_s))


def trained(
    frames: list[Frame], camera: Camera, config: ReconstructorConfig, steps: int, device: torch.device, line: dict
) -> None:
    """Run and evaluate one `fit`; `line` describes it."""
    learning = Reconstructor(config, camera, device=device)
    seen, held = split(frames)
    moments = {max(1, round(steps * share)) for share in MOMENTS}
    clock = Clock(device)

    def after_step(step: int, loss: Tensor) -> None:
        if step in moments:
            clock.pause()
            mean, worst = quality(learning, held, camera)
            result = {"seconds": clock.total_s, "steps": step, "held_out_db": mean, "worst_db": worst}
            result["training_db"] = quality(learning, seen[3::7], camera)[0]
            rounded = {name: round(value, 2) for name, value in result.items()}
            print(json.dumps(line | rounded | {"gaussians": learning.gaussians}), flush=True)
            clock.go_on()

    learning.fit(seen, steps, after_step)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--fields", nargs="*", default=["basis"])
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--set", action="append", metavar="NAME=VALUE,…")
    options = parser.parse_args()
    device = torch.device(options.device)
    for path in options.recordings:
        recording = open_recording(path, scale=options.scale)
        frames = list(recording)
        for name, values in itertools.product(options.fields, options.set or [""]):
            asked = ReplaySettings(path, Path("unused"), field=name)
            config = asked.reconstructor_config(recording.width_px * recording.height_px, offline=True)
            about = (frames, recording.camera, changed(config, values))
            steps = options.steps
            if device.type == "cuda":
                steps_within(1.0, *about, device)  # loads the kernels
            if options.seconds:
                steps = steps_within(options.seconds, *about, device)
            line = {"recording": recording.name, "field": name} | ({"set": values} if values else {})
            trained(*about, steps, device, line)


if __name__ == "__main__":
    main()
