"""Measure the fused image loss, SSIM and Adam on the CPU against torch.

    OMP_NUM_THREADS=2 python benchmarks/losses_cpu.py [--repeats 20]

Prints one line per measurement: the best and the median of the repeats, in milliseconds. 640x512 pixels; Adam over 50,000 Gaussians of
SH degree 3 (59 values each, 28 bytes read or written per value).
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch

from gsplat_core.ops.image_loss import image_loss
from gsplat_core.ops.native import instruction_set
from gsplat_core.ops.ssim import ssim_map
from gsplat_core.reference.training import image_loss as reference_image_loss
from gsplat_core.training.steps.optimiser import FusedAdam

WIDTH_PX, HEIGHT_PX, GAUSSIANS = 640, 512, 50_000
ROWS = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (16, 3)}


def measure(name: str, body: Callable[[], object], repeats: int) -> float:
    """Print and return the best time in milliseconds."""
    body()
    times_ms = []
    for _ in range(repeats):
        start = time.perf_counter()
        body()
        times_ms.append((time.perf_counter() - start) * 1e3)
    print(f"{name:52s} best {min(times_ms):8.2f} ms   median {statistics.median(times_ms):8.2f} ms")
    return min(times_ms)


def measure_losses(repeats: int) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(HEIGHT_PX, WIDTH_PX, 3, generator=generator)
    target = (torch.rand(image.shape, generator=generator) * 255).to(torch.uint8)
    floats = target.float() / 255
    mask = (torch.rand(HEIGHT_PX, WIDTH_PX, generator=generator) > 0.2).to(torch.uint8)
    depth, target_depth = 20 + 60 * torch.rand(2, HEIGHT_PX, WIDTH_PX, generator=generator)
    measure("L1, gradient, uint8 target, mask", lambda: image_loss(image, target, mask), repeats)
    fused = measure(
        "L1 + SSIM, gradient, uint8 target, mask", lambda: image_loss(image, target, mask, ssim_weight=0.2), repeats
    )
    measure("... and inverse depth", lambda: image_loss(image, target, mask, depth, target_depth, 0.2, 0.1), repeats)
    measure("SSIM map, forward only", lambda: ssim_map(image, floats), repeats)
    plain = measure(
        "L1 + SSIM, gradient, plain torch", lambda: reference_image_loss(image, target, mask, ssim_weight=0.2), 3
    )
    print(f"{'':52s} {plain / fused:.0f} times as long")


def measure_adam(repeats: int) -> None:
    parameters = {name: torch.randn(GAUSSIANS, *row).requires_grad_() for name, row in ROWS.items()}
    for tensor in parameters.values():
        tensor.grad = torch.randn_like(tensor)
    fused = FusedAdam(parameters, dict.fromkeys(ROWS, 1e-3))
    moved_gb = sum(tensor.numel() for tensor in parameters.values()) * 28e-9
    best_ms = measure("FusedAdam", lambda: fused.step(parameters), repeats)
    print(f"{'':52s} {moved_gb / best_ms * 1e3:.1f} GB/s")
    tensors = list(parameters.values())
    for name, optimiser in (
        ("torch.optim.Adam", torch.optim.Adam(tensors, lr=1e-3)),
        ("torch.optim.Adam(fused=True)", torch.optim.Adam(tensors, lr=1e-3, fused=True)),
    ):
        measure(name, optimiser.step, repeats)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--repeats", type=int, default=20)
    repeats = parser.parse_args().repeats
    print(f"{instruction_set()}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    measure_losses(repeats)
    measure_adam(repeats)


if __name__ == "__main__":
    main()
