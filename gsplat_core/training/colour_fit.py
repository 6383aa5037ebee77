"""Least-squares fit of colours to a picture with fixed geometry. Blending is linear in the colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians

LEAST_WEIGHT = 1e-6
"""Smallest weight of a Gaussian in the picture, in pixels; invisible ones have no gradient either.
"""


def colour_change(gaussians: Gaussians, camera: Camera, picture: Tensor, counts: Tensor, steps: int) -> Tensor:
    """Return the change of the constant colour coefficients [N, 3] that fits a picture.

    The update of `colour_correction` is repeated with Nesterov's momentum. No step size is needed,
    since the weights of a pixel sum to at most 1. A few steps remove large errors; further steps
    only improve detail smaller than a Gaussian.

    Args:
        gaussians: scene.
        camera: viewpoint.
        picture: target float [H, W, 3], 0 to 1.
        counts: weights [H, W], 1 for pixels to fit.
        steps: number of iterations.
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
    """Return pixel values [H, W, 3], computed from the rendered picture, summed for each Gaussian
    [N, 3] with its blending weights.
    """
    leaf = constant.detach().requires_grad_()
    with torch.enable_grad():
        sh = torch.cat([leaf[:, None], gaussians.sh[:, 1:]], dim=1)
        image = render(replace(gaussians, sh=sh), camera, depth=False).image
    (gathered,) = torch.autograd.grad(image, leaf, of_pixels(image.detach()))
    return gathered
