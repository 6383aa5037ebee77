"""Plane sweep and semi-global matching in plain torch and float64, test reference of `gsplat_core.ops.plane_sweep`.

`sweep_planes` returns costs that are not rounded. `select_planes` takes the integer costs of the op.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.ops.plane_sweep import COST_STEPS, DISAGREES, WINDOW_PX, MatchingCosts, Planes

NOISE_GREY = 2.0
"""Standard deviation of image noise in grey levels, added to variances so that patches without contrast do not correlate."""
AGREES = 0.2
"""Matching cost below which a view counts as agreeing."""
SEEN = 0.99
"""Smallest interpolated mask of a usable pixel."""
GREY_STEPS = 32
"""Number of units per grey level to which warped views are rounded."""
SMALL_STEP, LARGE_STEP = 0.02, 0.1
"""Penalties of semi-global matching for a difference of one label between neighbours, and of several."""


def sweep_planes(
    reference: Tensor, usable: Tensor, views: Tensor, views_usable: Tensor, homographies: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the mean costs float64 [H, W, D] and the numbers of agreeing views [H, W, D]. Arguments as those of the op."""
    grey, size = reference.double(), (*reference.shape, len(homographies))
    mean = window_mean(grey)
    variance = window_mean(grey.square()) - mean.square() + NOISE_GREY**2
    total, seen, votes = (torch.zeros(size, dtype=torch.float64) for _ in range(3))
    for label, of_views in enumerate(homographies):
        for view, mask, homography in zip(views, views_usable, of_views, strict=True):
            there = positions(homography, *reference.shape)
            other = torch.floor(GREY_STEPS * sampled(view.double(), there) + 0.5) / GREY_STEPS
            sees = (sampled((mask != 0).double(), there) > SEEN) & (usable != 0)
            other_mean = window_mean(other)
            other_variance = window_mean(other.square()) - other_mean.square() + NOISE_GREY**2
            covariance = window_mean(grey * other) - mean * other_mean
            cost = 0.5 - 0.5 * covariance / (variance * other_variance).sqrt()
            total[..., label] += torch.where(sees, cost.clamp(max=DISAGREES), 0)
            seen[..., label] += sees
            votes[..., label] += sees & (cost < AGREES)
    return torch.where(seen > 0, total / seen.clamp(min=1), DISAGREES), votes


def positions(homography: Tensor, height: int, width: int) -> Tensor:
    """Return where a homography maps the pixels, [H, W, 2]. Points behind the view's camera are NaN."""
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    mapped = torch.stack([x, y, torch.ones_like(x)], -1) @ homography.T
    return torch.where(mapped[..., 2:] > 0, mapped[..., :2] / mapped[..., 2:], torch.nan)


def sampled(picture: Tensor, there: Tensor) -> Tensor:
    """Interpolate a picture [H, W] bilinearly at positions [..., 2] as x and y. It is 0 outside and where positions are not
    finite.
    """
    height, width = picture.shape
    padded = torch.nn.functional.pad(picture, (1, 2, 1, 2))
    inside = there.isfinite().all(-1)
    x, y = (torch.where(inside, there[..., axis] + 1, 0).clamp(0, side + 1) for axis, side in ((0, width), (1, height)))
    left, top = x.floor().long(), y.floor().long()
    right, down = x - left, y - top
    rows = [padded[top + k, left] * (1 - right) + padded[top + k, left + 1] * right for k in (0, 1)]
    return torch.where(inside, rows[0] * (1 - down) + rows[1] * down, 0)


def window_mean(picture: Tensor) -> Tensor:
    """Return the mean over the window around each pixel of a picture [H, W], reflected at the border pixels."""
    for dim in (0, 1):
        around = torch.arange(picture.shape[dim])
        shifts = range(-(WINDOW_PX // 2), WINDOW_PX // 2 + 1)
        picture = torch.stack(
            [picture.index_select(dim, _reflected(around + shift, picture.shape[dim])) for shift in shifts]
        ).mean(0)
    return picture


def _reflected(index: Tensor, size: int) -> Tensor:
    if size == 1:
        return torch.zeros_like(index)
    folded = index.abs() % (2 * size - 2)
    return torch.minimum(folded, 2 * size - 2 - folded)


def aggregated(cost: Tensor) -> Tensor:
    """Return the sum of the path costs of semi-global matching from four directions, for matching costs [H, W, D]."""
    total = torch.zeros_like(cost)
    for dim in (0, 1):
        for forward in (True, False):
            lines = cost.movedim(dim, 0) if forward else cost.movedim(dim, 0).flip(0)
            paths = torch.stack(_path(lines))
            total += (paths if forward else paths.flip(0)).movedim(0, dim)
    return total


def _path(lines: Tensor) -> list[Tensor]:
    """Return the path costs [N, D] of each of the lines [lines, N, D], along the first axis."""
    labels = torch.arange(lines.shape[2])
    penalty = torch.tensor([0, SMALL_STEP, LARGE_STEP], dtype=torch.float64)[
        (labels[:, None] - labels).abs().clamp(max=2)
    ]
    paths = [lines[0]]
    for line in lines[1:]:
        before = paths[-1]
        paths.append(line + (before[:, None, :] + penalty).amin(2) - before.amin(1, keepdim=True))
    return paths


def select_planes(costs: MatchingCosts) -> Planes:
    """Return labels as `gsplat_core.ops.plane_sweep.select_planes` does, in float64."""
    cost = costs.costs.double() / COST_STEPS
    total = aggregated(cost)
    labels = torch.arange(total.shape[2])
    least, best = total.amin(2), (total - total.amin(2, keepdim=True) < 1e-9).int().argmax(2)
    label = best.double()
    if len(labels) > 2:
        inner = best.clamp(1, len(labels) - 2)[..., None]
        below, here, above = (total.gather(2, inner + step)[..., 0] for step in (-1, 0, 1))
        bend = below - 2 * here + above
        shift = torch.where(bend > 1e-9, 0.5 * (below - above) / bend.clamp(min=1e-9), 0)
        label = label + torch.where(best == inner[..., 0], shift, 0)
    second = torch.where((labels - best[..., None]).abs() <= 2, torch.inf, total).amin(2)
    nearest = label.round().long()[..., None]
    return Planes(
        label,
        (second - least) / least.clamp(min=1e-6),
        cost.gather(2, nearest)[..., 0],
        costs.votes.gather(2, nearest)[..., 0],
    )
