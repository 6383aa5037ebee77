"""Structural similarity (Wang et al. 2004) in plain torch: any floating dtype, differentiable.

Usual parameters: 11x11 Gaussian window of sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2, values in 0..1.
"""

from __future__ import annotations

import torch
from torch import Tensor

WINDOW_RADIUS_PX = 5
WINDOW_SIGMA_PX = 1.5
C1 = 0.01**2
C2 = 0.03**2


def gaussian_window() -> Tensor:
    """Return the 11 taps of the separable window, float64, with sum 1."""
    offsets = torch.arange(-WINDOW_RADIUS_PX, WINDOW_RADIUS_PX + 1, dtype=torch.float64)
    taps = torch.exp(-0.5 * (offsets / WINDOW_SIGMA_PX) ** 2)
    return taps / taps.sum()


def _blur(planes: Tensor) -> Tensor:
    """Filter planes [P, H, W] with the window and zero padding."""
    height, width = planes.shape[1:]
    taps = gaussian_window().tolist()
    padded = torch.nn.functional.pad(planes, (WINDOW_RADIUS_PX,) * 4)
    rows = sum(
        (tap * padded[:, k : k + height] for k, tap in enumerate(taps)), start=torch.zeros_like(padded[:, :height])
    )
    return sum((tap * rows[:, :, k : k + width] for k, tap in enumerate(taps)), start=torch.zeros_like(planes))


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Compute the structural similarity of each pixel and channel (Wang et al. 2004, equation 13).

    Args:
        image: [H, W, C], values in 0..1.
        target: [H, W, C], same dtype.

    Returns:
        [H, W, C], in -1..1.
    """
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_x, mean_y, square_x, square_y, product = _blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    variances = square_x + square_y - mean_x * mean_x - mean_y * mean_y
    covariance = product - mean_x * mean_y
    similarity = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    similarity = similarity / ((mean_x * mean_x + mean_y * mean_y + C1) * (variances + C2))
    return similarity.permute(1, 2, 0)
