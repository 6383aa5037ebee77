"""Measure CPU rendering of a tissue-like surface against the plain-torch reference.

    python benchmarks/splat_cpu.py                       # 50,000 Gaussians at 640x512, colours of degree 3 and expected depth
    python benchmarks/splat_cpu.py --skip-reference --threads 1

The scene is seeded: a bumpy surface about 60 mm before the scope, covered with flat, mostly opaque Gaussians of about
1.6 px. Prints one JSON object per line: median and best of the repetitions in milliseconds, and the ratio to the
reference (run once, in the same process; both are float32).
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import gsplat_core
from gsplat_core import reference
from gsplat_core.ops.native import instruction_set

FOCAL_PX = 560.0
DEPTH_MM = 60.0


def tissue(count: int, width: int, height: int, seed: int = 0) -> dict[str, Any]:
    """Return arguments of `rasterization` for a wavy surface seen by one pinhole camera."""
    g = torch.Generator().manual_seed(seed)
    u, v = torch.rand(count, generator=g) * width, torch.rand(count, generator=g) * height
    z = DEPTH_MM + 12 * torch.sin(u / 90) * torch.cos(v / 70) + 0.3 * torch.randn(count, generator=g)
    means = torch.stack([(u - width / 2) / FOCAL_PX * z, (v - height / 2) / FOCAL_PX * z, z], -1)
    size_px = 1.6 * torch.exp(0.5 * torch.randn(count, 3, generator=g))
    tilt = torch.tensor([1.0, 0, 0, 0]) + 0.3 * torch.randn(count, 4, generator=g)
    opacities = torch.sigmoid(1.5 + 1.5 * torch.randn(count, generator=g))
    sh = 0.1 * torch.randn(count, 16, 3, generator=g)
    sh[:, 0] += torch.tensor([1.0, -0.4, -0.6])
    return {
        "means": means,
        "quats": torch.nn.functional.normalize(tilt, dim=-1),
        "scales": size_px * (z / FOCAL_PX)[:, None] * torch.tensor([1.0, 1.0, 0.3]),
        "opacities": opacities,
        "colors": sh,
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[FOCAL_PX, 0, width / 2], [0, FOCAL_PX, height / 2], [0, 0, 1]]]),
        "width": width,
        "height": height,
        "sh_degree": 3,
        "packed": False,
        "render_mode": "RGB+ED",
    }


def milliseconds(function: Callable[[], object], repetitions: int, warm_up: int = 3) -> list[float]:
    """Return the wall time of each repetition in ms."""
    for _ in range(warm_up):
        function()
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        function()
        times.append((time.perf_counter() - start) * 1e3)
    return times


def forward(rasterization: Callable[..., Any], scene: dict[str, Any]) -> Tensor:
    """Render the image without autograd."""
    with torch.no_grad():
        return rasterization(**scene)[0]


def forward_backward(rasterization: Callable[..., Any], scene: dict[str, Any], target: Tensor) -> None:
    """Run one training step's rendering: L1 to a target, gradients to all five parameters."""
    leaves = {n: scene[n].detach().requires_grad_() for n in ("means", "quats", "scales", "opacities", "colors")}
    image, _, _ = rasterization(**(scene | leaves))
    (image - target).abs().mean().backward()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=50_000)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=512)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--skip-reference", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    scene = tissue(options.count, options.width, options.height)
    target = torch.rand(1, options.height, options.width, 4, generator=torch.Generator().manual_seed(1))
    machine = {
        "processor": platform.processor() or platform.machine(),
        "instructions": instruction_set(),
        "threads": options.threads,
        "torch": torch.__version__,
        "gaussians": options.count,
        "size_px": [options.width, options.height],
    }
    image = forward(gsplat_core.rasterization, scene)
    cases: dict[str, Callable[[Callable[..., Any]], object]] = {
        "forward": lambda rasterization: forward(rasterization, scene),
        "forward_backward": lambda rasterization: forward_backward(rasterization, scene, target),
    }
    for name, case in cases.items():
        times = milliseconds(lambda case=case: case(gsplat_core.rasterization), options.repetitions)  # type: ignore[misc]
        result = {"case": name, "median_ms": statistics.median(times), "best_ms": min(times)}
        if not options.skip_reference:
            (result["reference_ms"],) = milliseconds(lambda case=case: case(reference.rasterization), 1, 0)  # type: ignore[misc]
            result["times_the_reference"] = result["reference_ms"] / result["median_ms"]
        rounded = {key: value if isinstance(value, str) else round(value, 2) for key, value in result.items()}
        print(json.dumps(rounded | machine), flush=True)
    if not options.skip_reference:
        difference = (image - forward(reference.rasterization, scene)).abs()
        print(json.dumps({"case": "agreement", "largest": float(difference.max()), "mean": float(difference.mean())}))


if __name__ == "__main__":
    main()
