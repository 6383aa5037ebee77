"""Difference between one process and several, with Gaussians and cameras shared out over them.

    python benchmarks/gsplat/processes.py
    python benchmarks/gsplat/processes.py --device cuda     # one GPU for each process, over NCCL

The pictures and gradients of one process are compared with those of several processes together.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import log

from gsplat_core import rasterization
from gsplat_core.rendering.distributed import cli

WIDTH, HEIGHT = 160, 128
LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def scene(gaussians: int, cameras: int) -> dict[str, Tensor]:
    """Return Gaussians with spherical harmonics of degree 2 in front of cameras that look along z."""
    generator = torch.Generator().manual_seed(0)
    normal = lambda *shape: torch.randn(*shape, generator=generator)
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    viewmats[:, :3] += 0.05 * normal(cameras, 3, 4)
    K = torch.tensor([[140.0, 0, WIDTH / 2], [0, 140.0, HEIGHT / 2], [0, 0, 1]])
    return {
        "means": normal(gaussians, 3) * torch.tensor([2.0, 1.6, 1.5]) + torch.tensor([0.0, 0.0, 6.0]),
        "quats": normal(gaussians, 4),
        "scales": (normal(gaussians, 3) * 0.5 - 2.5).exp(),
        "opacities": normal(gaussians).sigmoid(),
        "colors": normal(gaussians, 9, 3) * 0.3,
        "viewmats": viewmats,
        "Ks": K.repeat(cameras, 1, 1),
    }


def share(values: dict[str, Tensor], rank: int, size: int) -> dict[str, Tensor]:
    """Return the Gaussians and cameras of one process; the first one has the fewest Gaussians."""
    n, cameras = len(values["means"]), len(values["viewmats"])
    first, last = (n * (rank + k) ** 2 // size**2 for k in (0, 1))
    views = slice(rank * cameras // size, (rank + 1) * cameras // size)
    return {
        name: tensor[views if name in ("viewmats", "Ks") else slice(first, last)] for name, tensor in values.items()
    }


def rendered(values: dict[str, Tensor], weights: Tensor, **options: Any) -> dict[str, Tensor]:
    """Return the picture, and the gradients of the sum of its values times `weights`."""
    leaves = {name: values[name].detach().clone().requires_grad_() for name in LEAVES}
    image, _, _ = rasterization(
        **leaves, Ks=values["Ks"], width=WIDTH, height=HEIGHT, sh_degree=2, render_mode="RGB+ED", **options
    )
    (image * weights).sum().backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return {"image": image.detach(), **gradients}


def weights_for(cameras: int) -> Tensor:
    """Return the weights [C, H, W, 4] of the pictures' values in the loss."""
    return torch.rand(cameras, HEIGHT, WIDTH, 4, generator=torch.Generator().manual_seed(1))


def worker(local_rank: int, rank: int, size: int, given: tuple[str, int, int, str]) -> None:
    """Render one process's share, and save its results to the folder."""
    folder, gaussians, cameras, kind = given
    device = torch.device("cuda", local_rank) if kind == "cuda" else torch.device("cpu")
    torch.set_num_threads(1)
    values = share(scene(gaussians, cameras), rank, size)
    weights = weights_for(cameras)[rank * cameras // size : (rank + 1) * cameras // size].to(device)
    results = {}
    for packed in (True, False):
        on_device = {name: tensor.to(device) for name, tensor in values.items()}
        for name, tensor in rendered(on_device, weights, packed=packed, distributed=True).items():
            results[f"{'packed' if packed else 'dense'}.{name}"] = tensor.cpu()
    torch.save(results, Path(folder) / f"{rank}.pt")


def differences(gaussians: int, cameras: int, size: int, device: str) -> dict[str, float]:
    """Return the largest difference of each result of `size` processes from that of one process.

    Gradients are relative to the largest one of one process.
    """
    with tempfile.TemporaryDirectory() as folder:
        cli(worker, (folder, gaussians, cameras, device), processes=None if device == "cuda" else size)
        parts = [torch.load(Path(folder) / f"{rank}.pt") for rank in range(size)]
    found = {}
    for packed in (True, False):
        whole = {name: tensor.to(device) for name, tensor in scene(gaussians, cameras).items()}
        one = rendered(whole, weights_for(cameras).to(device), packed=packed)
        for name, wanted in one.items():
            key = f"{'packed' if packed else 'dense'}.{name}"
            together = torch.cat([part[key] for part in parts])
            largest = 1.0 if name == "image" else float(wanted.abs().max())
            found[key] = float((together - wanted.cpu()).abs().max()) / largest
    return found


if __name__ == "__main__":
    parser = log.options("Compare processes that share Gaussians and cameras with one process.")
    parser.add_argument("--gaussians", type=int, default=5000)
    parser.add_argument("--cameras", type=int, default=4)
    chosen = parser.parse_args()
    size = torch.cuda.device_count() if chosen.device == "cuda" else 2
    found = differences(chosen.gaussians, chosen.cameras, size, chosen.device)
    figures: dict[str, Any] = {
        "processes": size,
        "backend": "nccl" if chosen.device == "cuda" else "gloo",
        "gaussians": chosen.gaussians,
        "cameras": chosen.cameras,
        "size_px": [WIDTH, HEIGHT],
        "picture": max(value for name, value in found.items() if name.endswith("image")),
        "gradients": max(value for name, value in found.items() if not name.endswith("image")),
    }
    log.write("processes", chosen, figures, folder="gsplat")
