"""Memory of one training step by the share of visible Gaussians: dense, packed, and packed with sparse gradients.

    python benchmarks/gsplat/memory.py
    python benchmarks/gsplat/memory.py --device cuda --full

Each figure comes from a process of its own. Peak memory is the increase from before the step to the largest value during
the forward and backward pass: resident memory on the CPU, allocated memory on a GPU.
"""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import log

from gsplat_core import rasterization

SHARES = (1.0, 0.5, 0.1, 0.01)
MODES: dict[str, dict[str, Any]] = {
    "dense": {"packed": False},
    "packed": {"packed": True},
    "packed, sparse_grad=True": {"packed": True, "sparse_grad": True},
    "packed, sparse_grad='all'": {"packed": True, "sparse_grad": "all"},
}
WIDTH, HEIGHT = 320, 256
LEAVES = ("means", "quats", "scales", "opacities", "colors")


def scene(count: int, share: float) -> dict[str, Tensor]:
    """Return small Gaussians with spherical harmonics of degree 3, of which a share is in view, in random order."""
    generator = torch.Generator().manual_seed(0)
    u, v = torch.rand(count, generator=generator) * 2 - 1, torch.rand(count, generator=generator) * 1.6 - 0.8
    z = 4 + torch.rand(count, generator=generator)
    behind = torch.randperm(count, generator=generator)[round(count * share) :]
    z[behind] *= -1
    K = torch.tensor([[WIDTH / 2.4, 0, WIDTH / 2], [0, WIDTH / 2.4, HEIGHT / 2], [0, 0, 1]])
    return {
        "means": torch.stack([u * z.abs(), v * z.abs(), z], -1),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.full((count, 3), 0.01),
        "opacities": torch.full((count,), 0.3),
        "colors": 0.1 * torch.randn(count, 16, 3, generator=generator),
        "viewmats": torch.eye(4)[None],
        "Ks": K[None],
    }


def bytes_of(gradient: Tensor | None) -> int:
    """Return the bytes that a gradient holds."""
    if gradient is None:
        return 0
    parts = (gradient._indices(), gradient._values()) if gradient.is_sparse else (gradient,)
    return sum(part.numel() * part.element_size() for part in parts)


def resident(field: str) -> int:
    """Return a value in bytes of this process's memory: VmRSS now, VmHWM at most."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith(field)))


def step(count: int, share: float, mode: str, device: str) -> dict[str, float]:
    """Render and backpropagate once; return the visible share and bytes."""
    torch.set_num_threads(1)

    def run(values: dict[str, Tensor]) -> tuple[float, int]:
        leaves = {name: values[name].to(device).requires_grad_() for name in LEAVES}
        cameras = {name: values[name].to(device) for name in ("viewmats", "Ks")}
        if device == "cuda":
            torch.cuda.reset_peak_memory_stats()
            before.append(torch.cuda.memory_allocated())
        else:
            ctypes.CDLL("libc.so.6").malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
            before.append(resident("VmRSS"))
        image, _, meta = rasterization(**leaves, **cameras, width=WIDTH, height=HEIGHT, sh_degree=3, **MODES[mode])
        image.sum().backward()
        seen = float((meta["radii"][..., 0] > 0).sum()) / len(values["means"])
        return seen, sum(bytes_of(leaf.grad) for leaf in leaves.values())

    before: list[int] = []
    run(scene(100, share))  # loads code
    seen, held = run(scene(count, share))
    peak = torch.cuda.max_memory_allocated() if device == "cuda" else resident("VmHWM")
    return {"visible": seen, "gradient_bytes": held, "peak_bytes": peak - before[-1]}


def in_new_process(*words: object) -> dict[str, float]:
    """Return the result of `step` in a process of its own."""
    done = subprocess.run(
        [sys.executable, __file__, "--step", json.dumps(words)], check=True, capture_output=True, text=True
    )
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result


if __name__ == "__main__":
    parser = log.options("Measure the memory of dense, packed and sparse gradients.")
    parser.add_argument("--step", help="arguments of one step as JSON, for a process of its own")
    chosen = parser.parse_args()
    if chosen.step:
        print(json.dumps(step(*json.loads(chosen.step))))
        sys.exit()
    count = 4_000_000 if chosen.full else 300_000
    rows = []
    for share in SHARES:
        for mode in MODES:
            found = in_new_process(count, share, mode, chosen.device)
            rows.append({"share": share, "mode": mode, **found})
            print(f"{share:5.0%} {mode:28s} gradients {found['gradient_bytes'] / 2**20:8.2f} MiB"
                  f"  peak {found['peak_bytes'] / 2**20:8.1f} MiB  visible {found['visible']:.3f}")  # fmt: skip
    log.write("memory", chosen, {"gaussians": count, "size_px": [WIDTH, HEIGHT], "rows": rows}, folder="gsplat")
