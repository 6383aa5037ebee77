"""Splat regression from one corner: metric-corrected descent with birth-death against Adam alone.

    python benchmarks/methods/regression.py [--sets 4] [--first 0] [--full] [--device cpu|cuda] [--out FILE]

The target of a seed is a sum of six round Gaussians of either sign in the unit square, at 400 points. All 32 splats start in one
corner. Both methods have the same number of steps. Adam's rate is the best of a grid for each set of 10 seeds, by the median loss
of these seeds. The defaults of `FitOptions` and the constants of `gsplat_core.regression` were chosen on seeds 100 to 129.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace

import log
import torch

from gsplat_core import reference
from gsplat_core.ops.splat_regression import splat_regression
from gsplat_core.regression import FitOptions, Splats, fit

SPLATS, POINTS, BUMPS = 32, 400, 6
ADAM_RATES = (0.32, 0.16, 0.08, 0.04, 0.02, 0.01, 0.005)
SET = 10
"""Number of seeds whose losses give one ratio."""


def target(seed: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Return points [n, 2] and values [n, 1]."""
    g = torch.Generator().manual_seed(seed)
    points, centres = torch.rand(POINTS, 2, generator=g), torch.rand(BUMPS, 2, generator=g)
    widths = 0.06 + 0.1 * torch.rand(BUMPS, generator=g)
    heights = torch.randn(BUMPS, generator=g).sign() * (0.5 + torch.rand(BUMPS, generator=g))
    values = torch.exp(-(points[:, None] - centres).square().sum(-1) / (2 * widths.square())) @ heights[:, None]
    return points.to(device), values.to(device)


def corner(seed: int, device: str) -> Splats:
    """Return splats whose centres are in [0, 0.05]²."""
    g = torch.Generator().manual_seed(100 + seed)
    return Splats(
        (0.05 * torch.rand(SPLATS, 2, generator=g)).to(device),
        0.05 * torch.eye(2, device=device).repeat(SPLATS, 1, 1),
        (1e-3 * torch.randn(SPLATS, 1, generator=g)).to(device),
    )


def final_loss(seed: int, options: FitOptions, device: str) -> float:
    """Return the final loss divided by the mean square of the values."""
    points, values = target(seed, device)
    fitted = fit(points, values, start=corner(seed, device), options=replace(options, seed=7 + seed))
    return float(fitted.losses[-1]) / float(values.square().mean())


def closed_form_error() -> float:
    """Return the largest difference of closed forms and autograd in float64, relative to the largest gradient."""
    g = torch.Generator().manual_seed(0)
    worst = 0.0
    for dims in (1, 2, 3, 4):
        points, centres = (torch.rand(n, dims, generator=g, dtype=torch.float64) for n in (200, 20))
        factors = 0.3 * torch.eye(dims, dtype=torch.float64) + 0.1 * torch.randn(
            20, dims, dims, generator=g, dtype=torch.float64
        )
        values = torch.randn(20, 3, generator=g, dtype=torch.float64)
        leaves = [t.requires_grad_() for t in (centres, factors, values)]
        out = reference.splat_regression(points, *leaves)
        gradient = torch.randn(out.shape, generator=g, dtype=torch.float64)
        wanted = torch.autograd.grad((out * gradient).sum(), leaves)
        found = reference.splat_regression_gradients(points, *(t.detach() for t in leaves), gradient)
        worst = max(worst, *(float((a - b).abs().max() / b.abs().max()) for a, b in zip(found, wanted, strict=True)))
    return worst


def step_ms(points: int, splats: int, device: str) -> dict[str, float]:
    """Return the median time of a forward and a backward pass in milliseconds, 3 variables and 3 values."""
    g = torch.Generator().manual_seed(0)
    x = torch.rand(points, 3, generator=g).to(device)
    tensors = [
        torch.rand(splats, 3, generator=g),
        0.1 * torch.eye(3).repeat(splats, 1, 1),
        torch.randn(splats, 3, generator=g),
    ]
    tensors = [t.to(device) for t in tensors]
    gradient = torch.rand(points, 3, generator=g).to(device)
    wait = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
    found = {}
    for name, call in {
        "forward": lambda: splat_regression(x, *tensors),
        "backward": lambda: torch.ops.gsplat_core.splat_regression_backward(x, *tensors, gradient),
    }.items():
        times = []
        for _ in range(8):
            start = time.perf_counter()
            call()
            wait()
            times.append((time.perf_counter() - start) * 1e3)
        found[name] = round(statistics.median(times[1:]), 3)
    return found


def flat(losses: list[list[float]]) -> list[float]:
    return [loss for each in losses for loss in each]


def main() -> None:
    parser = log.options("Splat regression: convergence from one corner, exactness and speed.")
    parser.add_argument("--sets", type=int, default=4, help=f"number of sets of {SET} seeds")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    chosen = parser.parse_args()
    options = FitOptions()
    alone = replace(options, metric=False, birth_death=False)
    sets = [range(chosen.first + SET * k, chosen.first + SET * (k + 1)) for k in range(chosen.sets)]

    def losses_of(options: FitOptions) -> list[list[float]]:
        return [[final_loss(s, options, chosen.device) for s in seeds] for seeds in sets]

    by_rate = {rate: losses_of(replace(alone, rate=rate)) for rate in ADAM_RATES}
    adam_rates = [min(by_rate, key=lambda rate: statistics.median(by_rate[rate][k])) for k in range(chosen.sets)]
    adam = [by_rate[rate][k] for k, rate in enumerate(adam_rates)]
    parts = {
        "metric and birth-death": options,
        "birth-death alone": replace(options, metric=False),
        "metric alone": replace(options, birth_death=False),
    }
    losses = {name: losses_of(part) for name, part in parts.items()}
    ours = losses["metric and birth-death"]
    ratios = [statistics.median(a) / statistics.median(b) for a, b in zip(ours, adam, strict=True)]
    each = [a / b for a, b in zip(flat(ours), flat(adam), strict=True)]
    size = (1_000_000, 1000) if chosen.full else (20_000, 200)
    log.write(
        "regression",
        chosen,
        {
            "closed_form_error": closed_form_error(),
            "sets": [f"{seeds[0]} to {seeds[-1]}" for seeds in sets],
            "adam_rates": adam_rates,
            "adam_median_loss_by_rate": {
                rate: round(statistics.median(flat(found)), 5) for rate, found in by_rate.items()
            },
            "median_loss": {name: round(statistics.median(flat(found)), 5) for name, found in losses.items()},
            "largest_loss": {name: round(max(flat(found)), 5) for name, found in losses.items()},
            "ratios_of_medians": [round(x, 4) for x in ratios],
            "ratio_of_medians": round(statistics.median(ratios), 4),
            "worst_ratio_of_medians": round(max(ratios), 4),
            "median_ratio": round(statistics.median(each), 4),
            "adam_losses": [[round(x, 5) for x in found] for found in adam],
            "losses": [[round(x, 5) for x in found] for found in ours],
            "op_points_splats": size,
            "op_ms": step_ms(*size, chosen.device),
        },
    )


if __name__ == "__main__":
    main()
