"""Measure the deformation fields on the CPU, as JSON: `python benchmarks/deformation_cpu.py [--gaussians N] [--threads N]`.

Measures the cost of a new time for a viewer (limits for 50,000 Gaussians: HexPlane 15 ms with the cache, basis field 6 ms) and of a training step, next to the
same work in plain torch.
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

from gsplat_core import reference
from gsplat_core.deformation import BasisField, BasisRates, HexPlaneField
from gsplat_core.ops.native import instruction_set
from gsplat_core.scene.gaussians import Gaussians

WINDOW_S = (0.0, 6.0)


def milliseconds(work: Callable[[float], Any], repeats: int) -> dict[str, float]:
    """Return median and minimum over `repeats` calls, each at a new time, after two warm-up calls."""
    taken = []
    for repeat in range(repeats + 2):
        at = 0.5 + 5.0 * repeat / (repeats + 2)
        start = time.perf_counter()
        work(at)
        taken.append((time.perf_counter() - start) * 1e3)
    counted = taken[2:]
    return {"median_ms": round(statistics.median(counted), 3), "min_ms": round(min(counted), 3)}


def basis_times(gaussians: Gaussians, repeats: int) -> dict[str, Any]:
    """Time the basis field with 26 bumps."""
    field = BasisField(gaussians.count, WINDOW_S, bumps=26)
    with torch.no_grad():
        field.weights.normal_(std=0.1)
    gradient = torch.randn(gaussians.count, 13)
    plain = (field.centers.data, field.log_widths.data, field.weights.data)
    at = field.cached(gaussians)
    return {
        "bumps": field.bumps,
        "parameters": sum(p.numel() for p in field.parameters()),
        "new_time": milliseconds(at, repeats),
        "new_time_plain_torch": milliseconds(lambda t: reference.basis_field(*plain, field.frame_time(t)), 3),
        "backward_and_adam": milliseconds(lambda t: field.adam_step(t, gradient, BasisRates()), repeats),
    }


def hexplane_times(gaussians: Gaussians, repeats: int) -> dict[str, Any]:
    """Time the HexPlane field with 32 channels, 2 levels and an MLP of 3 x 64."""
    field = HexPlaneField(gaussians, WINDOW_S)
    with torch.no_grad():
        field.head.weight.normal_(std=0.1)
    at = field.cached(gaussians)

    def plain(time_s: float) -> None:
        with torch.no_grad():
            coordinates = field.coordinates(gaussians.means, time_s)
            features = [reference.hexplane_features(coordinates, *planes.values()) for planes in field.planes]
            layers = [*field.trunk, field.head]
            reference.hexplane_decode(features, coordinates, [], [x.weight for x in layers], [x.bias for x in layers])

    def uncached(time_s: float) -> None:
        with torch.no_grad():
            field(gaussians, time_s)

    def train(time_s: float) -> None:
        moved = field(gaussians, time_s)
        (moved.means.sum() + moved.log_scales.sum() + moved.quats.sum()).backward()

    return {
        "parameters": sum(p.numel() for p in field.parameters()),
        "build_cache": milliseconds(lambda t: field.cached(gaussians), max(3, repeats // 4)),
        "new_time_cached": milliseconds(at, repeats),
        "new_time_uncached": milliseconds(uncached, repeats),
        "new_time_plain_torch": milliseconds(plain, 3),
        "forward_and_backward": milliseconds(train, max(3, repeats // 4)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    n = options.gaussians
    gaussians = Gaussians(torch.randn(n, 3), torch.randn(n, 4), torch.randn(n, 3), torch.randn(n), torch.randn(n, 1, 3))
    figures = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "instruction_set": instruction_set(),
            "threads": options.threads,
            "torch": torch.__version__,
        },
        "gaussians": n,
        "basis": basis_times(gaussians, options.repeats),
        "hexplane": hexplane_times(gaussians, options.repeats),
    }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
