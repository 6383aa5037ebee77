"""ADC against MCMC on a synthetic static scene, with half of ADC's Gaussians for MCMC.

    python benchmarks/gsplat/strategies.py [--device cpu|cuda] [--full] [--steps 1000] [--out FILE]

Known Gaussians form a textured floor and a textured ball. Their pictures from cameras around them are trained on, and pictures
from other cameras are scored. Training starts with a few noisy points of the surfaces, in a loop of gsplat's convention with
the learning rates and initial values of gsplat's trainer. ADC adds as many Gaussians as it does. MCMC gets half of that number as
its cap. `--full` trains larger pictures of more Gaussians with the steps, intervals and rates of gsplat's trainer. The seeds are
trained at the same time. Figures: median and worst of the seeds.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import log
import torch
from torch import Tensor

from gsplat_core import DefaultStrategy, MCMCStrategy, fused_ssim, rasterization

SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class Size:
    """Size of the pictures and of the scene."""

    width_px: int
    height_px: int
    focal_px: float
    views: int
    held_out: int
    first: int
    """Noisy points that training starts with."""
    side: int
    """Known Gaussians along a side of the floor."""
    ball: int
    """Known Gaussians of the ball."""


SIZES = {False: Size(64, 48, 60.0, 24, 8, 300, 44, 900), True: Size(320, 240, 300.0, 96, 32, 5000, 160, 11_900)}
DEFAULTS = {
    False: {
        "steps": 1000, "refine_every": 25, "relocate_every": 10, "reset_every": 1000, "grow_grad2d": 1e-3, "means_rate": 1.6e-3
    },
    True: {
        "steps": 30_000, "refine_every": 100, "relocate_every": 100, "reset_every": 3000, "grow_grad2d": 5e-4,
        "means_rate": 1.6e-4 * 2.6,
    },
}  # fmt: skip
"""Options for the small and the large scene. Those of the small one differ from gsplat's because it has fewer steps and smaller
pictures: ADC refines about once per pass over the pictures, and MCMC in 80 rounds where gsplat has 250. The gradient above which ADC multiplies is 0.0002 in gsplat, for larger pictures."""
BATCH = 1
FINAL_RATE = 0.01
"""Ratio of the final to the first learning rate of positions."""
INITIAL = {"adc": (0.1, 1.0), "mcmc": (0.5, 0.1)}
"""Opacity, and scale relative to the distance of neighbours, at the start; those of gsplat's trainer."""
SPARSITY = 0.01
"""Weights of the mean opacity and the mean scale for MCMC."""


def truth(size: Size, random: torch.Generator) -> dict[str, Tensor]:
    """Return the known Gaussians: a floor and a ball, with a coarse pattern and a fine random texture."""
    side = torch.linspace(-1.6, 1.6, size.side)
    floor = torch.cartesian_prod(side, side)
    floor = torch.cat([floor, torch.full((len(floor), 1), -0.5)], 1)
    rank = torch.arange(size.ball) + 0.5
    polar, around = torch.acos(1 - 2 * rank / size.ball), math.pi * (1 + 5**0.5) * rank
    ball = 0.5 * torch.stack([polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos()], 1)
    means = torch.cat([floor, ball])
    waves = (means[:, None] * torch.tensor([[9.0, 2.0, 5.0], [3.0, 11.0, 4.0], [7.0, 6.0, 13.0]])).sum(-1).sin()
    colors = (0.5 + 0.3 * waves + 0.25 * torch.randn(len(means), 3, generator=random)).clamp(0.02, 0.98)
    floor_scale, ball_scale = 0.037 * 44 / size.side, 0.033 * math.sqrt(900 / size.ball)
    scales = torch.cat([torch.full((len(floor), 3), floor_scale), torch.full((len(ball), 3), ball_scale)])
    quats = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    return {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": torch.full((len(means),), 0.9),
        "colors": colors,
    }


def cameras(size: Size) -> Tensor:
    """Return the viewing matrices [views + held_out, 4, 4] on two rings; every fourth one is held out."""
    total, found = size.views + size.held_out, []
    for number in range(total):
        angle, height = 2 * math.pi * number / total, 0.7 + 0.6 * (number % 2) + 0.15 * (number % 4 // 2)
        eye = torch.tensor([2.6 * math.cos(angle), 2.6 * math.sin(angle), height])
        forward = torch.nn.functional.normalize(-eye - torch.tensor([0.0, 0.0, 0.15]), dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
        matrix = torch.eye(4)
        matrix[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        matrix[:3, 3] = -matrix[:3, :3] @ eye
        found.append(matrix)
    return torch.stack(found)


def picture(scene: dict[str, Tensor], viewmats: Tensor, size: Size) -> tuple[Tensor, dict[str, Any]]:
    """Render activated Gaussians; [C, H, W, 3]."""
    width, height, focal = size.width_px, size.height_px, size.focal_px
    intrinsics = viewmats.new_tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    colors, _, info = rasterization(
        scene["means"], scene["quats"], scene["scales"], scene["opacities"], scene["colors"], viewmats,
        intrinsics.expand(len(viewmats), 3, 3), width, height, packed=False,
    )  # fmt: skip
    return colors, info


def start(known: dict[str, Tensor], kind: str, first: int, random: torch.Generator) -> torch.nn.ParameterDict:
    """Return raw parameters of `first` Gaussians near known ones, as from structure from motion."""
    opacity, relative = INITIAL[kind]
    chosen = torch.randperm(len(known["means"]), generator=random)[:first]
    means = known["means"][chosen] + 0.01 * torch.randn(first, 3, generator=random)
    apart = torch.cdist(means, means).topk(4, largest=False).values[:, 1:].square().mean(1).sqrt()
    params = {
        "means": means,
        "scales": (apart * relative).log()[:, None].repeat(1, 3),
        "quats": torch.rand(first, 4, generator=random),
        "opacities": torch.full((first,), opacity).logit(),
        "colors": known["colors"][chosen].logit(),
    }
    return torch.nn.ParameterDict(params)


def activated(params: torch.nn.ParameterDict) -> dict[str, Tensor]:
    """Return Gaussians as `rasterization` takes them."""
    return {
        "means": params["means"], "quats": params["quats"], "scales": params["scales"].exp(),
        "opacities": params["opacities"].sigmoid(), "colors": params["colors"].sigmoid(),
    }  # fmt: skip


def strategy_of(kind: str, steps: int, cap: int, options: argparse.Namespace) -> DefaultStrategy | MCMCStrategy:
    """Return the strategy with gsplat's defaults, its schedule shortened to the number of steps."""
    if kind == "adc":
        return DefaultStrategy(
            refine_start_iter=min(500, steps // 30), refine_stop_iter=steps // 2, refine_every=options.refine_every,
            reset_every=options.reset_every, grow_grad2d=options.grow_grad2d,
        )  # fmt: skip
    return MCMCStrategy(
        cap_max=cap, noise_lr=options.noise_lr, refine_start_iter=min(500, steps // 30), refine_stop_iter=steps * 5 // 6,
        refine_every=options.relocate_every,
    )  # fmt: skip


def train(kind: str, seed: int, cap: int, options: argparse.Namespace) -> dict[str, float]:
    """Train one scene and score it on held-out pictures."""
    device, size = torch.device(options.device), SIZES[options.full]
    torch.manual_seed(seed)
    random = torch.Generator().manual_seed(seed)
    known = truth(size, torch.Generator().manual_seed(100))
    views = cameras(size).to(device)
    held = torch.arange(len(views)) % 4 == 2
    with torch.no_grad():
        placed = {name: value.to(device) for name, value in known.items()}
        wanted = torch.cat([picture(placed, view[None], size)[0] for view in views])
    noise = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(200)).to(device)
    seen = (wanted + options.noise / 255 * noise).clamp(0, 1)
    params = start(known, kind, size.first, random).to(device)
    rates = {"means": options.means_rate, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "colors": 2.5e-2}
    optimizers = {
        name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15, fused=device.type == "cuda") for name, rate in rates.items()
    }  # fmt: skip
    strategy = strategy_of(kind, options.steps, cap, options)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=2.6) if kind == "adc" else strategy.initialize_state()
    training = torch.nonzero(~held)[:, 0]
    begin, peak = time.perf_counter(), 0
    for step in range(options.steps):
        rate = rates["means"] * FINAL_RATE ** (step / options.steps)
        optimizers["means"].param_groups[0]["lr"] = rate
        chosen = training[torch.randint(len(training), (BATCH,), generator=random)]
        colors, info = picture(activated(params), views[chosen], size)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        target = seen[chosen]
        loss = 0.8 * (colors - target).abs().mean()
        loss = loss + 0.2 * (1 - fused_ssim(colors.movedim(-1, 1), target.movedim(-1, 1), padding="valid"))
        if kind == "mcmc":
            loss = loss + SPARSITY * (params["opacities"].sigmoid().mean() + params["scales"].exp().mean())
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if kind == "adc":
            strategy.step_post_backward(params, optimizers, state, step, info)
        else:
            strategy.step_post_backward(params, optimizers, state, step, info, lr=rate)
        peak = max(peak, len(params["means"]))
    with torch.no_grad():
        shown = torch.cat([picture(activated(params), view[None], size)[0] for view in views[held]])
        error = (shown.clamp(0, 1) - wanted[held]).square().mean((1, 2, 3))
    return {
        "psnr_db": round(float((-10 * error.log10()).mean()), 3),
        "gaussians": len(params["means"]),
        "most_gaussians": peak,
        "seconds": round(time.perf_counter() - begin, 1),
    }


def both(seed: int, options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Train by ADC, and by MCMC with a share of its Gaussians."""
    torch.set_num_threads(1)
    adc = train("adc", seed, 0, options)
    return {"adc": adc, "mcmc": train("mcmc", seed, int(options.share * adc["gaussians"]), options)}


def summary(runs: list[dict[str, dict[str, float]]]) -> dict[str, Any]:
    """Return median and worst of the seeds."""
    gains = [run["mcmc"]["psnr_db"] - run["adc"]["psnr_db"] for run in runs]
    found: dict[str, Any] = {"gain_db": {"median": round(statistics.median(gains), 3), "worst": round(min(gains), 3)}}
    for kind in ("adc", "mcmc"):
        scores = [run[kind]["psnr_db"] for run in runs]
        found[kind] = {
            "psnr_db": {"median": statistics.median(scores), "worst": min(scores)},
            "gaussians": statistics.median(run[kind]["gaussians"] for run in runs),
        }
    return {**found, "runs": runs}


def main() -> None:
    """Train, print and log."""
    parser = log.options("ADC against MCMC with half of its Gaussians.")
    parser.add_argument("--steps", type=int, help="1,000, or 30,000 with --full")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    for word, words in (
        ("refine-every", "for ADC"), ("relocate-every", "for MCMC"), ("reset-every", "for ADC")
    ):  # fmt: skip
        parser.add_argument(f"--{word}", type=int, help=f"steps, {words}")
    parser.add_argument("--grow-grad2d", type=float, help="of ADC")
    parser.add_argument("--noise-lr", type=float, default=5e5)
    parser.add_argument("--means-rate", type=float, help="first learning rate of positions")
    parser.add_argument("--noise", type=float, default=0.0, help="noise of the training pictures in grey levels")
    parser.add_argument("--share", type=float, default=0.5, help="cap of MCMC relative to ADC's Gaussians")
    chosen = parser.parse_args()
    for option, value in DEFAULTS[chosen.full].items():
        if getattr(chosen, option) is None:
            setattr(chosen, option, value)
    with ProcessPoolExecutor(len(chosen.seeds), mp_context=get_context("spawn")) as pool:
        runs = list(pool.map(both, chosen.seeds, [chosen] * len(chosen.seeds)))
    size = SIZES[chosen.full]
    name = f"noise of {chosen.noise:g} grey levels" if chosen.noise else "no noise"
    figures: dict[str, Any] = {
        "views": size.views, "held_out": size.held_out, "size_px": [size.width_px, size.height_px], "steps": chosen.steps,
        "share": chosen.share, "seeds": list(chosen.seeds),
        "options": {option: getattr(chosen, option) for option in DEFAULTS[chosen.full]},
        "scenes": {name: summary(runs)},
    }  # fmt: skip
    log.write("strategies", chosen, figures, folder="gsplat")


if __name__ == "__main__":
    main()
