"""Scene of gsplat's tests and profiles: points and cameras of an `.npz` file, with random Gaussians at the points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput

LARGEST_SCALE = 0.02
"""Largest standard deviation of the Gaussians along an axis."""


def load_test_data(
    data_path: str | Path | None = None,
    device: torch.device | str = "cuda",
    scene_crop: tuple[float, float, float, float, float, float] = (-2, -2, -2, 2, 2, 2),
    scene_grid: int = 1,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, int, int]:
    """Return means, quats, scales, opacities, colors, viewmats, Ks, width and height.

    Args:
        data_path: file with means3d [N, 3], colors [N, 3] from 0 to 255, viewmats [C, 4, 4], Ks [C, 3, 3], width and height.
        device: device of the tensors.
        scene_crop: smallest and largest x, y, z of the points that are kept.
        scene_grid: the scene is repeated this many times along x and y; odd.

    Raises:
        InvalidInput: without a file, or for an even `scene_grid`.
    """
    if data_path is None:
        raise InvalidInput("load_test_data needs data_path: this package does not contain gsplat's test scene")
    if scene_grid % 2 != 1:
        raise InvalidInput(f"scene_grid must be odd, got {scene_grid}")
    with np.load(data_path) as data:
        read = lambda name: torch.from_numpy(np.asarray(data[name], np.float32)).to(device)
        means, colors, viewmats, Ks = read("means3d"), read("colors") / 255, read("viewmats"), read("Ks")
        width, height = int(data["width"]), int(data["height"])
    low, high = torch.tensor(scene_crop, device=device, dtype=means.dtype).split(3)
    kept = ((means >= low) & (means <= high)).all(-1)
    means, colors = means[kept], colors[kept]
    half = scene_grid // 2
    steps = torch.arange(-half, half + 1, device=device, dtype=means.dtype)
    cells = torch.cartesian_prod(steps, steps)
    shifts = torch.cat([cells, torch.zeros_like(cells[:, :1])], 1) * (high - low)
    means = (means[None] + shifts[:, None]).reshape(-1, 3)
    colors = colors.repeat(len(shifts), 1)
    n = len(means)
    scales = LARGEST_SCALE * torch.rand(n, 3, device=device)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, device=device), dim=-1)
    opacities = torch.rand(n, device=device)
    return means, quats, scales, opacities, colors, viewmats, Ks, width, height
