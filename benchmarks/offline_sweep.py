"""Sweep of offline training: many configurations in one process, one JSON line for each moment that is evaluated.

    python benchmarks/offline_sweep.py --recording cutting --seconds 8 --device cuda '{"name": "a", "spacing": 0.1}' …
    python benchmarks/offline_sweep.py --recording cutting --scale 0.25 --steps 2000 --device cpu …

A configuration is a JSON object of `Options`' fields; `--configs FILE` reads one per line. Held-out frames are never trained on.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsplat_core.deformation.basis import BasisField
from gsplat_core.deformation.basis_kind import BasisLearningRates
from gsplat_core.deformation.hexplane import HexPlaneField
from gsplat_core.deformation.hexplane_kind import HexPlaneLearningRates
from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.rendering.rasterization import render
from gsplat_core.training import densification
from gsplat_core.training.config import LearningRates, ReconstructorConfig
from gsplat_core.training.densification import densify, shares_of
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.step import TrainingStep

PIXELS_PER_GAUSSIAN = 2.5


@dataclass
class Options:
    name: str = ""
    field: str = "basis"
    gaussians: int = 30_000  # at full size; scaled with the pixels
    spacing: float = 0.2
    final: float = 0.1
    schedule: str = "exponential"
    warm: float = 0.0
    rate: float = 1.0
    """Of everything."""
    canonical: float = 1.0
    """Multiplier of the Gaussians' own rates."""
    rates: dict = dataclasses.field(default_factory=dict)
    field_rates: dict = dataclasses.field(default_factory=dict)
    loss: str = "l1"
    ssim: float = 0.0
    average: float = 0.04
    """Horizon of the moving average, as a share of all steps."""
    smooth: float = 0.0
    smooth_every: int = 20
    seconds: float | None = None
    steps: int | None = None
    recording: str | None = None
    hexplane: dict = dataclasses.field(default_factory=dict)
    static: float = 0.0
    """Share of the steps at first that leaves the field alone."""
    seed: int = 0
    densify: int = 0
    """Rounds of densification."""
    most: int = 0
    """Gaussians at its end, at full size."""
    until: float = 0.5
    unseen: float = 0.05
    epsilon: float = 1e-8
    cloned_from: int = 0
    beta2: float = 0.999


@functools.cache
def frames_of(path: Path, scale: float, crop: tuple[int, ...] | None):  # type: ignore[no-untyped-def]
    recording = open_recording(path, scale=scale)
    frames, camera = list(recording), recording.camera
    if crop:
        x, y, width, height = crop
        inside = slice(y, y + height), slice(x, x + width)
        frames = [f.with_fields(image=f.image[inside], mask=None if f.mask is None else f.mask[inside]) for f in frames]
        intrinsics = camera.K.copy()
        intrinsics[:2, 2] -= x, y
        camera = dataclasses.replace(camera, K=intrinsics, width_px=width, height_px=height)
    return camera, frames


class Run:
    def __init__(self, options: Options, root: Path, scale: float, device: str, crop=None) -> None:  # type: ignore[no-untyped-def]
        self.options, self.device = options, torch.device(device)
        self.camera, frames = frames_of(root / (options.recording or "cutting"), scale, crop)
        pixels = self.camera.width_px * self.camera.height_px
        count = round(options.gaussians * (pixels / (640 * 512) if scale < 1 or crop else 1))
        count = min(count, round(pixels / PIXELS_PER_GAUSSIAN))
        kind_rates = BasisLearningRates if options.field == "basis" else HexPlaneLearningRates
        base, defaults = LearningRates(), kind_rates()
        rates = {
            n: options.rates.get(n, v) * options.rate * options.canonical for n, v in vars(base).items() if n != "field"
        }
        of_field = {n: options.field_rates.get(n, v) * options.rate for n, v in vars(defaults).items()}
        config = ReconstructorConfig(
            field=options.field, gaussians=count, max_gaussians=2 * count, bump_spacing_s=options.spacing,
            ssim_weight=options.ssim, squared_error=options.loss == "l2", rates=LearningRates(**rates, field=kind_rates(**of_field)),
        )  # fmt: skip
        self.train = [(f, Observation.of(f, self.camera, self.device)) for f in frames if not is_heldout(f.seq)]
        self.held = [Observation.of(f, self.camera, self.device) for f in frames if is_heldout(f.seq)]
        self.most = round(count * options.most / options.gaussians)
        self.first_count = count
        self.learning = Reconstructor(config, self.camera, seed=options.seed, device=self.device)
        first, last = self.train[0], self.train[-1]
        if options.field == "hexplane" and options.hexplane:
            self._start_hexplane(config, first, last)
        else:
            self.learning._start(*first, end_s=last[1].time_s)
        for frame, observation in self.train[1:]:
            self.learning._grow(frame, observation)
        self.step: TrainingStep = self.learning._step
        self.step._adam.betas = (0.9, options.beta2)
        BasisField.adam_step_at.__defaults__ = ((0.9, 0.999), options.epsilon)
        self.average: list[Tensor] | None = None

    def _start_hexplane(self, config: ReconstructorConfig, first, last) -> None:  # type: ignore[no-untyped-def]
        frame, observation = first
        learning = self.learning
        gaussians = gaussians_from_frame(
            frame, observation.camera, config.gaussians, sh_degree=0, default_depth_mm=60.0, seed=0
        ).to(self.device)
        learning.camera = observation.camera
        torch.manual_seed(0)
        made = HexPlaneField(gaussians, (observation.time_s, last[1].time_s), **self.options.hexplane).to(self.device)
        learning._step = TrainingStep(gaussians, made, config, learning.camera)

    def rate_at(self, share: float) -> float:
        options = self.options
        if share < options.warm:
            return (share + 1e-3) / (options.warm + 1e-3)
        if options.schedule == "cosine":
            return options.final + (1 - options.final) * 0.5 * (1 + math.cos(math.pi * share))
        if options.schedule == "flat-cosine":  # constant for the first half
            part = max(0.0, 2 * share - 1)
            return options.final + (1 - options.final) * 0.5 * (1 + math.cos(math.pi * part))
        if options.schedule == "linear":
            return 1 - (1 - options.final) * share
        return options.final**share

    def parameters(self) -> list[Tensor]:
        return [*self.step.gaussians.tensors().values(), *(p.data for p in self.step.field.parameters())]

    @torch.no_grad()
    def psnr(self, observations: list[Observation]) -> tuple[float, float]:
        values = []
        for one in observations:
            image = render(self.step.at(one.time_s), one.camera).image
            image = (image.clamp(0, 1) * 255).round() / 255
            inside = (one.mask > 0)[..., None]
            error = ((image - one.image.float() / 255) * inside).square().sum() / (3 * inside.sum())
            values.append(-10 * torch.log10(error))
        values = torch.stack(values)
        return float(values.mean()), float(values.min())

    def evaluate(self) -> dict[str, float]:
        seen = [one for frame, one in self.train if frame.seq % 8 == 5]
        held, worst = self.psnr(self.held)
        result = {"held": held, "worst": worst, "train": self.psnr(seen)[0]}
        if self.average is not None:
            now = [p.clone() for p in self.parameters()]
            torch._foreach_copy_(self.parameters(), self.average)
            result["held_avg"], result["worst_avg"] = self.psnr(self.held)
            result["train_avg"] = self.psnr(seen)[0]
            torch._foreach_copy_(self.parameters(), now)
        return {name: round(value, 2) for name, value in result.items()}

    def densify(self, random: np.random.Generator, done: float) -> None:
        chosen = [self.train[i][1] for i in random.permutation(len(self.train))[:16]]
        count = round(self.first_count + (self.most - self.first_count) * done)
        densification.UNSEEN_PX = self.options.unseen
        densify(self.step, shares_of(self.step, chosen), count)
        self.average = None

    def smooth_field(self, rate: float) -> None:
        """Towards the mean of the neighbours in time: `smooth` of the way in a pass over all frames."""
        share = self.options.smooth_every / len(self.train)
        self.step.field.smooth_in_time(min(0.5, self.options.smooth * rate * share))

    def __call__(self, seconds: float | None, steps: int | None, moments: list[float]) -> None:
        options = self.options
        seconds, steps = options.seconds or seconds, options.steps or steps
        random = np.random.default_rng(options.seed)
        order: list[int] = []
        moments = sorted(moments)
        elapsed, done, share = 0.0, 0, 0.0
        every = 10
        rounds = [options.until * (k + 1) / options.densify for k in range(options.densify)]
        total = len(rounds)
        field_rates = self.step._field_rates
        started = time.perf_counter()
        while True:
            share = done / steps if steps else (elapsed + time.perf_counter() - started) / seconds
            if moments and share >= moments[0]:
                moments.pop(0)
                self._sync()
                elapsed += time.perf_counter() - started
                line = {"name": options.name, "s": round(elapsed, 2), "step": done, **self.evaluate()}
                print(json.dumps(line | {"n": self.step.gaussians.count}), flush=True)
                started = time.perf_counter()
            if share >= 1:
                return
            if rounds and share >= rounds[0]:
                rounds.pop(0)
                self.densify(random, (total - len(rounds)) / total)
            if not order:
                order = random.permutation(len(self.train)).tolist()
            rate = self.rate_at(share)
            if options.static:
                self.step._scaled_for = None
                zero = {n: 0.0 for n in vars(field_rates)}
                self.step._field_rates = type(field_rates)(**zero) if share < options.static else field_rates
            self.step(self.train[order.pop()][1], rate_scale=rate)
            done += 1
            if done % every == 0 and options.average and share > 0.05:
                self._take_average(every, done, share)
            if options.smooth and done % options.smooth_every == 0:
                self.smooth_field(rate)

    def _take_average(self, every: int, done: int, share: float) -> None:
        now = self.parameters()
        if self.average is None or self.average[0].shape != now[0].shape:
            self.average = [p.clone() for p in now]
            return
        horizon = max(self.options.average * done / share, every)
        torch._foreach_lerp_(self.average, now, min(1.0, every / horizon))

    def _sync(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", nargs="*")
    parser.add_argument("--configs-file")
    parser.add_argument("--recording", default="cutting")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--crop", type=int, nargs=4, help="x y width height of a part of the picture")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--moments", type=float, nargs="*", default=[0.33, 0.66, 1.0])
    parser.add_argument("--limit", type=float, default=1e9, help="seconds after which no configuration is begun")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    root = Path(os.environ.get("INTRASPLAT_RECORDINGS") or os.environ["RECORDINGS"])
    lines = options.configs or [line for line in Path(options.configs_file).read_text().splitlines() if line.strip()]
    begun = time.perf_counter()
    for line in lines:
        if time.perf_counter() - begun > options.limit:
            print(json.dumps({"skipped": line}))
            continue
        values = json.loads(line)
        values.setdefault("recording", options.recording)
        values.setdefault("name", line)
        try:
            run = Run(
                Options(**values), root, options.scale, options.device, tuple(options.crop) if options.crop else None
            )
            run(options.seconds, options.steps, list(options.moments))
            del run
        except Exception as error:
            print(json.dumps({"name": values["name"], "failed": f"{type(error).__name__}: {error}"[:300]}), flush=True)
            if "--raise" in sys.argv:
                raise
        if options.device == "cuda":
            torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
