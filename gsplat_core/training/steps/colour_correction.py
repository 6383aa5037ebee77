"""Corrections of colours with fixed geometry.

A picture is linear in the colours of its splats: I_p = sum_k w_kp c_k, with blending weights w. A live stream corrects
colours from the residual of a picture by SIRT (Gilbert 1972), an iteration from tomography without a learning rate.
Each colour moves by the weighted mean of the residual over the pixels that show it. The weights of a pixel sum to at
most 1, so the squared error never grows for a relaxation up to 2. Low-frequency residuals vanish in the first step, and
colours without residual do not move. `colour_change` repeats the iteration to fit a whole picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gsplat_core.errors import InvalidSetting
from gsplat_core.ops.frame_gradients import ColourCorrection
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.config import ReconstructorConfig

MOST_RELAXATION = 2.0
"""Upper bound of the relaxation. The iteration need not converge at or above it."""
LEAST_WEIGHT_PX = 0.3
"""Offset in pixels, added to a splat's sum of blending weights before the residual is divided by it. Barely visible splats
are thus corrected less.
"""


def colour_correction(colours: Tensor, residuals: Tensor, weights: Tensor, relaxation: float) -> Tensor:
    """Return the correction of `colours` [N, 3], which are displayed clamped at 0.

    Args:
        colours: unclamped colours [N, 3]. Negative ones can rise but do not fall further.
        residuals: [N, 3], sum over tissue pixels of blending weight times (target - picture).
        weights: [N], sum over tissue pixels of blending weight.
        relaxation: share of the mean residual to apply, above 0 and below `MOST_RELAXATION`.

    Returns:
        [N, 3], at most `relaxation` times the largest residual of a pixel, and 0 for splats outside the tissue.
    """
    wanted = relaxation * residuals / (weights + LEAST_WEIGHT_PX)[:, None]
    return torch.maximum(wanted, -colours.clamp(min=0))


class ResidualTarget:
    """Target picture for the residual of a captured step, at fixed addresses."""

    def __init__(self, image: Tensor) -> None:
        """Allocate buffers for pictures of the size and device of `image` [H, W, 3]."""
        shape = (*image.shape[:2], 4)
        self._wanted = torch.zeros(shape, device=image.device)
        self._tissue = torch.zeros(shape, device=image.device)
        """Weights [H, W, 4]: the tissue mask in the three colour channels, 0 in the depth channel."""

    def take(self, image: Tensor, mask: Tensor) -> None:
        """Queue the copy of the next observation: uint8 picture [H, W, 3] and mask [H, W]."""
        tissue = (mask != 0).float()[..., None]
        self._tissue[..., :3].copy_(tissue.expand(-1, -1, 3))
        self._wanted[..., :3].copy_(image.float().div_(255).mul_(tissue))
        self._wanted[..., 3:].copy_(tissue)

    def correction(self, shown: Tensor, relaxation: Tensor) -> ColourCorrection:
        """Return the correction for a picture `shown` [H, W, 4], whose fourth channel is ignored."""
        return ColourCorrection(torch.addcmul(self._wanted, shown, self._tissue, value=-1), relaxation)


def check_colours(relaxation: float, config: ReconstructorConfig, device: torch.device) -> None:
    """Check that colours can be corrected with this relaxation.

    Raises:
        InvalidSetting: for view-dependent colours on a GPU.
    """
    if relaxation == 0:
        return
    if device.type == "cuda" and config.sh_degree > 0:
        raise InvalidSetting(
            f"colour_relaxation is {relaxation} with sh_degree {config.sh_degree}: on a GPU view-dependent colours are"
            " not corrected; set sh_degree or colour_relaxation to 0"
        )


LEAST_WEIGHT = 1e-6
"""Smallest sum of blending weights in pixels; avoids a division by zero for invisible Gaussians."""


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
