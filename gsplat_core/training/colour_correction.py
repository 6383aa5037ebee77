"""Colours straight from what a picture is off by, without a learning rate: SIRT (Gilbert 1972), as in tomography.

A picture is linear in the colours of its splats: I_p = sum_k w_kp c_k, with the weights w of blending. Each colour moves by the mean of the
residual over the pixels that show it, weighted as they show it. As a pixel's weights add up to at most 1, the squared error never grows for a
relaxation of up to 2; what is broad in the residual goes in the first step, and where there is no residual nothing moves.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidSetting
from gsplat_core.ops.frame_gradients.frame_gradients import ColourCorrection
from gsplat_core.training.config import ReconstructorConfig

MOST_RELAXATION = 2.0
"""From here on the iteration need not converge."""
LEAST_WEIGHT_PX = 0.3
"""Added to a splat's weight: one that is hardly seen, in less than a pixel, takes little of what stands there."""


def colour_correction(colours: Tensor, residuals: Tensor, weights: Tensor, relaxation: float) -> Tensor:
    """What to add to `colours` [N, 3], which are shown clamped at 0.

    Args:
        colours: before they are clamped. Those below 0 can rise and do not sink further.
        residuals: [N, 3], sum over tissue pixels of blending weight times (picture wanted - picture shown).
        weights: [N], sum over tissue pixels of blending weight.
        relaxation: share of the mean residual that is taken, above 0 and below `MOST_RELAXATION`.

    Never more than `relaxation` times the largest residual of a pixel, and 0 for a splat that no tissue pixel shows.
    """
    wanted = relaxation * residuals / (weights + LEAST_WEIGHT_PX)[:, None]
    return torch.maximum(wanted, -colours.clamp(min=0))


class ResidualTarget:
    """An observation as a captured step takes residuals against it, at fixed addresses."""

    def __init__(self, image: Tensor) -> None:
        """`image` [H, W, 3] is one of the size and device of all that come."""
        shape = (*image.shape[:2], 4)
        self._wanted = torch.zeros(shape, device=image.device)
        self._tissue = torch.zeros(shape, device=image.device)
        """The same three times, then 0."""

    def take(self, image: Tensor, mask: Tensor) -> None:
        """The next observation: uint8 [H, W, 3] and [H, W]. Queued, without a wait."""
        tissue = (mask != 0).float()[..., None]
        self._tissue[..., :3].copy_(tissue.expand(-1, -1, 3))
        self._wanted[..., :3].copy_(image.float().div_(255).mul_(tissue))
        self._wanted[..., 3:].copy_(tissue)

    def correction(self, shown: Tensor, relaxation: Tensor) -> ColourCorrection:
        """For the picture `shown` [H, W, 4], whose fourth channel is not looked at."""
        return ColourCorrection(torch.addcmul(self._wanted, shown, self._tissue, value=-1), relaxation)


def check_colours(relaxation: float, config: ReconstructorConfig, device: torch.device) -> None:
    """Raises InvalidSetting where colours cannot be corrected by so much of what a picture is off by."""
    if relaxation == 0:
        return
    if device.type == "cuda" and config.sh_degree > 0:
        raise InvalidSetting(
            f"colour_relaxation is {relaxation} with sh_degree {config.sh_degree}: on a GPU colours that depend on the view are"
            " not corrected; set sh_degree or colour_relaxation to 0"
        )
