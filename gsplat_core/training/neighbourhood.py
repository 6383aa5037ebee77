"""Density and depth of Gaussians around the cells of a picture grid."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.unseen import depth_of, pixels_of

DEPTH_STEPS = 2**24
"""Quantisation steps of the largest depth, as fine as float32."""


def around_cells(
    now: Gaussians, camera: Camera, spacing: float, shape: tuple[int, int], reach: int = 1
) -> tuple[Tensor, Tensor]:
    """Count Gaussian centres around each cell of a picture grid and average their depth.

    Args:
        now: the scene at the camera's time.
        camera: camera of the picture.
        spacing: side of a cell in pixels.
        shape: number of rows and columns of cells.
        reach: number of neighbouring cells on each side that are included, also beyond the
            picture's edge.

    Returns:
        Number of centres and their mean depth (0 for none), float32 [rows, columns] each.
    """
    rows, columns = (cells + 2 * reach for cells in shape)
    pixels, near = pixels_of(now.means, camera, margin_px=reach * spacing)
    cells = torch.floor(pixels / spacing).long() + reach
    inside = near & (cells[:, 0] < columns) & (cells[:, 1] < rows) & (cells >= 0).all(1)
    index = torch.where(inside, cells[:, 1] * columns + cells[:, 0], 0)
    depth = depth_of(now.means, camera)
    # Integer sums on a GPU do not depend on the order of summation.
    quantum = depth.abs().amax().clamp(min=1e-30) / DEPTH_STEPS if len(depth) else depth.new_ones(())
    each = torch.stack([torch.ones_like(index), torch.round(depth / quantum).long()]) * inside
    sums = each.new_zeros(2, rows * columns).index_add_(1, index, each).to(torch.float32)
    width = 2 * reach + 1
    count, total = torch.nn.functional.avg_pool2d(sums.view(2, rows, columns), width, stride=1) * width**2
    return count, total / count.clamp(min=1) * quantum
