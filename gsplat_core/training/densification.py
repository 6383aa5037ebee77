"""More Gaussians where the pictures are still off, none where nobody sees them: between the steps of offline training.

A Gaussian's part in the error is the gradient trick of Rota Bulò et al. 2024 ("Revising Densification in Gaussian Splatting", section
3.1): the gradient of a colour that every Gaussian has, for a picture weighted by the error, is the error under its blending weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.observations import Observation
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import Seen

UNSEEN_PX = 0.5
"""A Gaussian whose blending weights add up to less than this in every picture is not seen."""
SHRINK = 1.6
"""Both halves of a split Gaussian are smaller than it by this factor (Kerbl et al. 2023, section 5.2)."""
APART = 0.5
"""How far the halves are moved from their parent's centre, in its own standard deviations along its longest axis."""


@dataclass(frozen=True)
class Shares:
    """What each Gaussian has to do with some pictures; tensors [N]."""

    seen_px: Tensor
    """Sum of its blending weights over tissue, in the picture where that is largest."""
    error: Tensor
    """Sum of its blending weights times the absolute error (mean of the channels), over all pictures."""


def shares_of(step: TrainingStep, observations: Sequence[Observation]) -> Shares:
    """Each Gaussian's part in the pictures of `observations` and in their error, as the scene is now."""
    count = step.gaussians.count
    seen, error = (step.gaussians.means.new_zeros(count) for _ in range(2))
    for one in observations:
        now = step.seen_by(one)
        with torch.no_grad():
            picture = render(now, one.camera).image
            tissue = (one.mask > 0).to(picture.dtype)
            off = (picture - one.image.to(picture.dtype) / 255).abs().mean(-1) * tissue
        # All of one grey, so that no colour is clamped: only the blending weights are wanted.
        grey = torch.zeros_like(now.sh).requires_grad_()
        picture = render(replace(now, sh=grey), one.camera).image
        weighted = (picture * torch.stack([tissue, off, torch.zeros_like(off)], -1)).sum()
        (gradient,) = torch.autograd.grad(weighted, grey)
        of_constant = gradient[:, 0] / SH_C0
        seen = torch.maximum(seen, of_constant[:, 0])
        error += of_constant[:, 1]
    return Shares(seen, error)


@torch.no_grad()
def on_tissue(step: TrainingStep, observations: Sequence[Observation]) -> Tensor:
    """Which Gaussians have their centre on tissue in at least one of these pictures, bool [N]; all where a camera is no pinhole."""
    if any(one.camera.model != "pinhole" for one in observations):
        return torch.ones(step.gaussians.count, dtype=torch.bool, device=step.gaussians.device)
    found = torch.zeros(step.gaussians.count, dtype=torch.bool, device=step.gaussians.device)
    for one in observations:
        seen = Seen(one.camera, step.at(one.time_s).means)
        found |= seen.inside[:, 0] & (seen.read(one.mask) > 0)
    return found


@torch.no_grad()
def densify(step: TrainingStep, shares: Shares, count: int) -> None:
    """Drop the Gaussians that nobody sees, and split those with the largest error until there are `count`."""
    unseen = shares.seen_px < UNSEEN_PX
    left = step.gaussians.count - int(torch.count_nonzero(unseen))
    wanted = min(count - left, left)
    if wanted <= 0:
        return
    order = step.remove(unseen).order
    step.split(shares.error[order].argsort(descending=True, stable=True)[:wanted], halves)


def halves(parents: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Two Gaussians in the place of each: apart along the longest axis, smaller, and together about as opaque."""
    longest = parents.log_scales.argmax(1)
    along = torch.nn.functional.one_hot(longest, 3).to(parents.dtype)
    axis = _turned(parents.quats, along)
    reach = parents.log_scales.gather(1, longest[:, None]).exp() * APART
    smaller = parents.log_scales - math.log(SHRINK) * along
    sides = (replace(parents, means=parents.means + side * reach * axis, log_scales=smaller) for side in (-1, 1))
    first, second = sides
    return first, second


def _turned(quats: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [N, 3] turned by quaternions wxyz [N, 4] of any length: v + 2 w (q x v) + 2 q x (q x v)."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    w, q = unit[:, :1], unit[:, 1:]
    across = torch.linalg.cross(q, vectors)
    return vectors + 2 * (w * across + torch.linalg.cross(q, across))
