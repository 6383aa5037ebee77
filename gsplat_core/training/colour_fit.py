"""Colours that make a scene, as it stands, look like a picture: one linear least-squares problem, since blending is linear in colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians

LEAST_WEIGHT = 1e-6
"""Of a Gaussian in the picture, in pixels; one that is not seen has no gradient either."""


def colour_change(gaussians: Gaussians, camera: Camera, picture: Tensor, counts: Tensor, steps: int) -> Tensor:
    """What to add to the constant coefficients, [N, 3], so that the camera sees `picture` [H, W, 3], 0 to 1, where `counts` [H, W] is 1.

    The update of `colour_correction`, repeated, with Nesterov's momentum: each Gaussian takes the mean of what its pixels lack, weighted as it is
    blended into them. No rate has to be chosen, since the weights of a pixel sum to at most 1. Few steps correct what is large; what it takes
    many for is smaller than a Gaussian.
    """
    weights = _gathered(gaussians, gaussians.sh[:, 0], camera, torch.ones_like)
    per_weight = 1 / (SH_C0 * weights.clamp(min=LEAST_WEIGHT))
    reached = ahead = gaussians.sh[:, 0].detach()
    for step in range(steps):
        towards = _gathered(gaussians, ahead, camera, lambda image: (picture - image) * counts[..., None])
        before, reached = reached, ahead + towards * per_weight
        ahead = reached + step / (step + 3) * (reached - before)
    return reached - gaussians.sh[:, 0].detach()


def _gathered(gaussians: Gaussians, constant: Tensor, camera: Camera, of_pixels: Callable[[Tensor], Tensor]) -> Tensor:
    """What pixels [H, W, 3] hold, which is made from the picture with those constant coefficients, summed for each Gaussian [N, 3] as it is
    blended into them."""
    leaf = constant.detach().requires_grad_()
    with torch.enable_grad():
        sh = torch.cat([leaf[:, None], gaussians.sh[:, 1:]], dim=1)
        image = render(replace(gaussians, sh=sh), camera, depth=False).image
    (gathered,) = torch.autograd.grad(image, leaf, of_pixels(image.detach()))
    return gathered
