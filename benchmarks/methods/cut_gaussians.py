"""Pictures of polygons fitted by cut Gaussians and by Gaussians at equal bytes.

    python benchmarks/methods/cut_gaussians.py [--pictures 3] [--splats 64] [--steps 500] [--full] [--device cpu|cuda] [--out FILE]

A picture has eight random triangles and quadrangles of uniform colours, antialiased by 8x8 samples. A Gaussian has 14 float32
numbers (as a .ply of degree 0); each curve adds 8. Plain Gaussians get as many splats as give the same bytes. All splats start
on a jittered grid, and have the same rates and numbers of steps.
"""

from __future__ import annotations

import statistics
import time

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


def fitted_db(
    picture: torch.Tensor, count: int, curves: int, steps: int, seed: int, device: str, distance: float
) -> tuple[float, float]:
    """Return the PSNR of the fit, and milliseconds of a step."""
    size = len(picture)
    camera = Camera(np.eye(3), size, size, model="ortho")
    scene = first_splats(count, size, picture, seed).to(device)
    kernel = KERNELS["cut" if curves else "gaussian"]()
    if curves:
        scene = with_curves(scene, curves, torch.Generator().manual_seed(seed), distance)
    scene.requires_grad_()
    background = picture.mean((0, 1)).to(device).requires_grad_()
    tensors = scene.tensors()
    groups = [{"params": [tensor], "rate": RATES[name.removeprefix("extra.")]} for name, tensor in tensors.items()]
    optimiser = torch.optim.Adam([*groups, {"params": [background], "rate": 1e-2}], eps=1e-12)
    wanted, best = picture.to(device), 0.0
    start = time.perf_counter()
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = group["rate"] * 0.02 ** (step / steps)
        off = render_kernel(scene, camera, kernel, background) - wanted
        loss = off.square().mean()
        best = max(best, float(-10 * torch.log10(loss.detach()))) if step % 25 == 0 or step == steps - 1 else best
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return best, (time.perf_counter() - start) / steps * 1e3


def main() -> None:
    parser = log.options("Pictures of polygons fitted by cut Gaussians and by Gaussians at equal bytes.")
    parser.add_argument("--pictures", type=int, default=3)
    parser.add_argument("--splats", type=int, default=64, help="number of cut Gaussians with one curve")
    parser.add_argument("--curves", default="1,2,3")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--distance", type=float, default=1.0, help="of a curve at the start, in standard deviations")
    chosen = parser.parse_args()
    if chosen.full:
        chosen.pictures, chosen.splats, chosen.steps, chosen.size = 10, 400, 3000, 256
    numbers = chosen.splats * (NUMBERS + PER_CURVE)
    counts = {curves: numbers // (NUMBERS + PER_CURVE * curves) for curves in (0, *map(int, chosen.curves.split(",")))}
    pictures = [polygons(chosen.size, seed) for seed in range(chosen.pictures)]
    db, ms = {}, {}
    for curves, count in counts.items():
        each = [
            fitted_db(picture, count, curves, chosen.steps, seed, chosen.device, chosen.distance)
            for seed, picture in enumerate(pictures)
        ]
        db[curves] = [round(value, 2) for value, _ in each]
        ms[curves] = round(statistics.median(value for _, value in each), 1)
        print(f"{curves} curves, {count} splats: {db[curves]} dB, {ms[curves]} ms a step", flush=True)
    gains = {
        curves: round(statistics.mean(a - b for a, b in zip(db[curves], db[0], strict=True)), 2)
        for curves in db
        if curves
    }
    log.write(
        "cut_gaussians",
        chosen,
        {
            "size": chosen.size, "steps": chosen.steps, "bytes": 4 * numbers, "splats_by_curves": counts,
            "db_by_curves": db, "step_ms_by_curves": ms, "mean_gain_db_by_curves": gains,
            "gain_db": max(gains.values()),
        },
    )  # fmt: skip


if __name__ == "__main__":
    main()
