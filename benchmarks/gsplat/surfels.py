"""Time of surfels (2D Gaussian Splatting) beside that of 3D Gaussians, and the error of depth and normal on a plane.

    python benchmarks/gsplat/surfels.py
    PYTHONPATH=build/peers python benchmarks/gsplat/surfels.py --device cuda --full --gsplat

Both renderers, and with `--gsplat` gsplat's `rasterization_2dgs`, too, get the same centres, rotations, scales and
opacities. They take turns, and each time is the median. On the CPU it is processor time, which other programs of the
machine do not lengthen.
"""

from __future__ import annotations

import importlib
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import log

from gsplat_core import rasterization, rasterization_2dgs

PLANE_TILTS_DEG = (0, 30, 60)
LEAVES = ("means", "quats", "scales", "opacities", "colors")


def scene(count: int, width: int, height: int, device: str) -> dict[str, Any]:
    """Return flat Gaussians on a curved surface in front of one camera."""
    generator = torch.Generator().manual_seed(0)
    uniform = lambda *shape: torch.rand(*shape, generator=generator)
    x, y = (uniform(2, count) - 0.5) * torch.tensor([[2.6], [2.1]])
    means = torch.stack([x, y, 2.4 + 0.3 * torch.sin(3 * x) * torch.cos(2 * y) + 0.02 * uniform(count)], -1)
    size = 1.4 * math.sqrt(2.6 * 2.1 / count)
    focal = 0.9 * width
    tensors = {
        "means": means,
        "quats": torch.tensor([1.0, 0, 0, 0]) + 0.25 * torch.randn(count, 4, generator=generator),
        "scales": size * torch.exp(uniform(count, 3) - 0.5) * torch.tensor([1, 1, 0.1]),
        "opacities": 0.3 + 0.6 * uniform(count),
        "colors": uniform(1, count, 3),  # for each camera; gsplat's 2DGS with depth takes no others
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]]),
    }
    return {**{name: value.to(device) for name, value in tensors.items()}, "width": width, "height": height}


def seconds(call: Callable[[], object], device: str) -> float:
    """Return the time of one call."""
    if device == "cpu":
        start = time.process_time()
        call()
        return time.process_time() - start
    torch.cuda.synchronize()
    start = time.perf_counter()
    call()
    torch.cuda.synchronize()
    return time.perf_counter() - start


def times(values: dict[str, Any], device: str, repeats: int, gsplat: bool) -> dict[str, float]:
    """Return median times in ms of the renderers, forward and with gradients, and ratios of surfels to Gaussians."""
    calls: dict[str, Callable[[], object]] = {}
    renderers = {"gaussians": rasterization, "surfels": rasterization_2dgs}
    if gsplat:
        renderers["gsplat"] = importlib.import_module("gsplat").rasterization_2dgs
    for name, function in renderers.items():

        def forward(function: Callable[..., Any] = function) -> object:
            with torch.no_grad():
                return function(**values, packed=False, render_mode="RGB+ED")

        def step(function: Callable[..., Any] = function) -> object:
            leaves = {leaf: values[leaf].clone().requires_grad_() for leaf in LEAVES}
            image, alphas, *rest = function(**{**values, **leaves}, packed=False, render_mode="RGB+ED")
            loss = image.mean() + alphas.mean()
            if function is not rasterization:
                loss = loss + rest[0].mean() + rest[2].mean()
            loss.backward()
            return loss

        calls[f"{name}_forward"], calls[f"{name}_step"] = forward, step
    for call in calls.values():
        call()
    found: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            found[name].append(seconds(call, device))
    result = {f"{name}_ms": round(1e3 * statistics.median(each), 3) for name, each in found.items()}
    for what in ("forward", "step"):
        result[f"{what}_ratio"] = round(result[f"surfels_{what}_ms"] / result[f"gaussians_{what}_ms"], 2)
    return result


def plane_errors(tilt_deg: float, spacing: float, device: str) -> dict[str, float]:
    """Return errors on a plane of surfels at a distance of 40, turned round y."""
    angle, width, height, focal = math.radians(tilt_deg), 96, 72, 200.0
    steps = torch.arange(-34.0, 34.0, spacing)
    a, b = (axis.ravel() for axis in torch.meshgrid(steps, steps / 2, indexing="xy"))
    means = torch.stack([a * math.cos(angle), b, 40 + a * math.sin(angle)], 1)
    count = len(means)
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]])
    inputs: dict[str, Tensor] = {
        "means": means,
        "quats": torch.tensor([math.cos(angle / 2), 0, -math.sin(angle / 2), 0]).repeat(count, 1),
        "scales": torch.full((count, 3), spacing),
        "opacities": torch.full((count,), 0.9),
        "colors": torch.rand(count, 3),
        "viewmats": torch.eye(4)[None],
        "Ks": K,
    }
    inputs = {name: value.to(device) for name, value in inputs.items()}
    with torch.no_grad():
        image, alphas, normals, surface, _, medians, _ = rasterization_2dgs(
            **inputs, width=width, height=height, render_mode="RGB+ED"
        )
    x = (torch.arange(width, device=device) + 0.5 - width / 2) / focal
    exact = 40 / (1 - math.tan(angle) * x)
    normal = torch.tensor([math.sin(angle), 0, -math.cos(angle)], device=device)
    assert surface is not None and alphas.min() > 0.9
    degrees = lambda n: float(torch.rad2deg(torch.acos(((n @ normal).abs() / n.norm(dim=-1)).clamp(max=1))).mean())
    return {
        "depth_percent": round(100 * float((image[0, ..., 3] / exact - 1).abs().mean()), 3),
        "median_percent": round(100 * float((medians[0, ..., 0] / exact - 1).abs().mean()), 3),
        "normal_deg": round(degrees(normals[0]), 4),
        "depth_normal_deg": round(degrees(surface[1:-1, 1:-1]), 3),
    }


def main() -> None:
    """Measure, print and log."""
    parser = log.options("surfels beside Gaussians")
    parser.add_argument("--gsplat", action="store_true", help="time gsplat's rasterization_2dgs, too; needs CUDA")
    chosen = parser.parse_args()
    count, width, height = (50_000, 640, 512)
    values = scene(count, width, height, chosen.device)
    figures: dict[str, Any] = {
        "gaussians": count,
        "width_px": width,
        "height_px": height,
        "threads": torch.get_num_threads(),
        "constants": "1.6",
    }
    figures |= times(values, chosen.device, 50 if chosen.full else 9, chosen.gsplat)
    figures["planes"] = {
        f"{tilt} deg, surfels of {spacing}": plane_errors(tilt, spacing, chosen.device)
        for tilt in PLANE_TILTS_DEG
        for spacing in (1.0, 0.5)
    }
    log.write("surfels", chosen, figures, folder="gsplat")


if __name__ == "__main__":
    main()
