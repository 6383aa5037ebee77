"""Pictures of polygons fitted by cut Gaussians and by Gaussians at equal bytes.

    python benchmarks/methods/cut_gaussians.py [--pictures 8] [--splats 32] [--steps 1000] [--full] [--device cpu|cuda] [--out FILE]

A picture has eight random triangles and quadrangles of uniform colours, antialiased by 8x8 samples. A Gaussian has 14 float32
numbers (as a .ply of degree 0); each curve adds 8. Plain Gaussians get as many splats as give the same bytes. All splats start
on a jittered grid, and have the same number of steps. The factor on the learning rates is searched for each number of curves
in the same grid, on other pictures than the reported ones. The same search chooses the number of curves.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import log
import numpy as np
import torch

from gsplat_core.choices import KERNELS
from gsplat_core.experimental.cut_gaussians import CURVES, render_kernel, with_curves
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians

NUMBERS, PER_CURVE, FINER = 14, 8, 8
RATES = {"means": 0.4, "quats": 2e-2, "log_scales": 3e-2, "logit_opacities": 5e-2, "sh": 3e-2, CURVES: 2e-2}
FACTORS = (2.0, 4.0, 8.0)
"""Factors on `RATES` among which the best is chosen."""
WIDEST_PX, NARROWED = 4.0, 0.7
"""Width of an edge at the start, and the share of the steps after which it is 1 pixel. It decreases geometrically."""
FIRST_CHOICE = 100
"""Seed of the first picture that the factors and the number of curves are chosen on."""


def polygons(size: int, seed: int) -> torch.Tensor:
    """Return a picture float32 [size, size, 3]."""
    random = np.random.default_rng(seed)
    fine = np.empty((size * FINER, size * FINER, 3), np.float32)
    fine[:] = random.uniform(0.1, 0.9, 3)
    for corners in random.integers(3, 5, 8):
        centre = random.uniform(0.15, 0.85, 2)
        angles = np.sort(random.uniform(0, 2 * np.pi, corners))
        radii = random.uniform(0.15, 0.4, corners)
        points = centre + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
        cv2.fillPoly(fine, [np.round(points * size * FINER).astype(np.int32)], random.uniform(0, 1, 3).tolist())
    return torch.tensor(cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA))


def first_splats(count: int, size: int, picture: torch.Tensor, seed: int) -> Gaussians:
    """Return round splats on a jittered grid with the picture's colours, in pixels before an orthographic camera."""
    random = torch.Generator().manual_seed(seed)
    side = int(np.ceil(count**0.5))
    order = torch.randperm(side * side, generator=random)[:count]
    cells = torch.stack([order % side, torch.div(order, side, rounding_mode="floor")], 1)
    places = (cells + torch.rand(count, 2, generator=random)) * (size / side)
    pixels = places.long().clamp(max=size - 1)
    depth = 10 + torch.rand(count, 1, generator=random)
    width = torch.tensor([0.5 * size / side, 0.5 * size / side, 0.1]).log()
    return Gaussians(
        torch.cat([places, depth], 1), torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), width.repeat(count, 1),
        torch.zeros(count), ((picture[pixels[:, 1], pixels[:, 0]] - 0.5) / SH_C0)[:, None],
    )  # fmt: skip


def fitted_db(seed: int, count: int, curves: int, factor: float, chosen: argparse.Namespace) -> tuple[float, float]:
    """Return the PSNR of the fit of a picture with edges of 1 pixel, and milliseconds of a step."""
    size, steps, picture = chosen.size, chosen.steps, polygons(chosen.size, seed)
    camera = Camera(np.eye(3), size, size, model="ortho")
    scene = first_splats(count, size, picture, seed).to(chosen.device)
    if curves:
        scene = with_curves(scene, curves, torch.Generator().manual_seed(seed), chosen.distance)
    scene.requires_grad_()
    background = picture.mean((0, 1)).to(chosen.device).requires_grad_()
    groups = [
        {"params": [tensor], "rate": factor * RATES[name.removeprefix("extra.")]}
        for name, tensor in scene.tensors().items()
    ]
    optimiser = torch.optim.Adam([*groups, {"params": [background], "rate": 1e-2}], eps=1e-12)
    wanted = picture.to(chosen.device)

    def loss_at(width_px: float) -> torch.Tensor:
        kernel = KERNELS["cut"](width_px) if curves else KERNELS["gaussian"]()
        return (render_kernel(scene, camera, kernel, background) - wanted).square().mean()

    start = time.perf_counter()
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = group["rate"] * 0.02 ** (step / steps)
        loss = loss_at(WIDEST_PX ** max(0.0, 1 - step / steps / NARROWED))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    step_ms = (time.perf_counter() - start) / steps * 1e3
    if chosen.save:
        save(Path(chosen.save) / f"{seed}-{curves}.png", render_kernel(scene, camera, KERNELS["cut" if curves else "gaussian"](), background), picture)  # fmt: skip
    with torch.no_grad():
        return float(-10 * torch.log10(loss_at(1.0))), step_ms


def save(path: Path, fitted: torch.Tensor, picture: torch.Tensor) -> None:
    """Write the picture and its fit next to each other, enlarged four times."""
    both = torch.cat([picture, fitted.detach().cpu().clamp(0, 1)], 1).numpy()
    enlarged = cv2.resize((both[..., ::-1] * 255).astype(np.uint8), None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), enlarged)


def main() -> None:
    parser = log.options("Pictures of polygons fitted by cut Gaussians and by Gaussians at equal bytes.")
    parser.add_argument("--pictures", type=int, default=8)
    parser.add_argument(
        "--chosen-on", type=int, default=2, help="number of other pictures that the rates are chosen on"
    )
    parser.add_argument("--splats", type=int, default=32, help="number of cut Gaussians with one curve")
    parser.add_argument("--curves", default="2")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--distance", type=float, default=1.5, help="of a curve at the start, in standard deviations")
    parser.add_argument("--workers", type=int, default=2, help="processes; each fits one picture at a time")
    parser.add_argument("--save", default="", help="folder for the fitted pictures")
    chosen = parser.parse_args()
    if chosen.full:
        chosen.pictures, chosen.splats, chosen.steps, chosen.size = 10, 400, 3000, 256
    numbers = chosen.splats * (NUMBERS + PER_CURVE)
    counts = {curves: numbers // (NUMBERS + PER_CURVE * curves) for curves in (0, *map(int, chosen.curves.split(",")))}
    others = range(FIRST_CHOICE, FIRST_CHOICE + chosen.chosen_on)
    db, ms, searched, best = {}, {}, {}, {}
    with ProcessPoolExecutor(chosen.workers, mp_context=multiprocessing.get_context("spawn")) as workers:

        def fits(curves: int, factors: Sequence[float], seeds: Sequence[int]) -> list[tuple[float, float]]:
            runs = [
                workers.submit(fitted_db, s, counts[curves], curves, factor, chosen)
                for factor in factors
                for s in seeds
            ]
            return [run.result() for run in runs]

        for curves, count in counts.items():
            found = [value for value, _ in fits(curves, FACTORS, others)]
            searched[curves] = {
                factor: round(statistics.mean(found[k * chosen.chosen_on : (k + 1) * chosen.chosen_on]), 2)
                for k, factor in enumerate(FACTORS)
            }
            best[curves] = max(searched[curves], key=searched[curves].__getitem__)
            print(f"{curves} curves: {searched[curves]} dB by the factor on the rates", flush=True)
            each = fits(curves, [best[curves]], range(chosen.pictures))
            db[curves] = [round(value, 2) for value, _ in each]
            ms[curves] = round(statistics.median(value for _, value in each), 1)
            print(f"{curves} curves, {count} splats: {db[curves]} dB, {ms[curves]} ms a step", flush=True)
    gains = {curves: [round(a - b, 2) for a, b in zip(db[curves], db[0], strict=True)] for curves in db if curves}
    number = max(gains, key=lambda curves: searched[curves][best[curves]])
    log.write(
        "cut_gaussians",
        chosen,
        {
            "size": chosen.size, "steps": chosen.steps, "bytes": 4 * numbers, "splats_by_curves": counts,
            "factor_by_curves": best, "searched_db_by_curves_and_factor": searched, "db_by_curves": db,
            "step_ms_by_curves": ms, "gains_db_by_curves": gains, "curves": number,
            "gain_db": round(statistics.mean(gains[number]), 2),
            "median_gain_db": round(statistics.median(gains[number]), 2), "worst_gain_db": min(gains[number]),
        },
    )  # fmt: skip


if __name__ == "__main__":
    main()
