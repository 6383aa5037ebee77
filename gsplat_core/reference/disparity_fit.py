"""Disparity refinement in plain torch: test reference of `gsplat_core.ops.disparity_fit`."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.reference.stereo_matching import UNKNOWN, _moved

STEPS, STEP_MOST, START_MOST = 3, 0.5, 0.7
RADIUS, SIGMA = 12, 4.0
RESISTANCE, OUTLIER, INDEPENDENT_PIXELS, LEAST_KNOWN = 4.0, 6.0, 20.0, 1e-3


def fit_disparities(
    left: Tensor, right: Tensor, sixteenths: Tensor, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """Return refined disparities and their standard deviations [H, W] in pixels, in `dtype`."""
    known = sixteenths != UNKNOWN
    there = known.to(dtype)
    start = torch.where(known, sixteenths, 0).to(dtype) / 16
    bright, other = left.to(dtype), right.to(dtype)
    rises = [_moved(other, down, 1) - _moved(other, down, -1) for down in (-1, 0, 1)]
    slope = (3 * rises[0] + 10 * rises[1] + 3 * rises[2]) / 32
    share = window(there).clamp(min=LEAST_KNOWN)
    current, information, spread = start, there, there
    for _ in range(STEPS):
        seen, rise = _taken_from(other, current), _taken_from(slope, current)
        differs = there * (bright - seen)
        differs = differs - window(differs) / share
        weight = there / (1 + (differs / OUTLIER) ** 2)
        information = window(weight * rise * rise)
        step = window(weight * rise * differs) / (information + RESISTANCE)
        moved = current - step.clamp(-STEP_MOST, STEP_MOST)
        current = start + (moved - start).clamp(-START_MOST, START_MOST)
        spread = window(weight * differs * differs)
    variance = (spread + share) / (INDEPENDENT_PIXELS * information).clamp(min=1e-6)
    return torch.where(known, current, 0), torch.where(known, variance.sqrt(), torch.inf)


def window(plane: Tensor) -> Tensor:
    """Filter a plane with a Gaussian window and zero padding."""
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=plane.dtype, device=plane.device)
    taps = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    taps = taps / taps.sum()
    smooth = torch.nn.functional.conv2d(plane[None, None], taps.reshape(1, 1, -1, 1), padding=(RADIUS, 0))
    return torch.nn.functional.conv2d(smooth, taps.reshape(1, 1, 1, -1), padding=(0, RADIUS))[0, 0]


def _taken_from(plane: Tensor, disparity: Tensor) -> Tensor:
    """Sample a plane at the columns displaced by the disparities, with linear interpolation."""
    width = plane.shape[1]
    columns = (torch.arange(width, dtype=plane.dtype, device=plane.device) - disparity).clamp(0, width - 1)
    first = columns.floor().long()
    values, later = plane.gather(1, first), plane.gather(1, (first + 1).clamp(max=width - 1))
    return values + (columns - first) * (later - values)
