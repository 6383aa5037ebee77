"""Correction of colours from the residual of a picture by SIRT (Gilbert 1972), an iteration from
tomography without a learning rate.

A picture is linear in the colours of its splats: I_p = sum_k w_kp c_k, with blending weights w.
Each colour moves by the weighted mean of the residual over the pixels that show it. The weights of
a pixel sum to at most 1, so the squared error never grows for a relaxation up to 2. Low-frequency
residuals vanish in the first step, and colours without residual do not move.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidSetting
from gsplat_core.ops.frame_gradients.frame_gradients import ColourCorrection
from gsplat_core.training.config import ReconstructorConfig

MOST_RELAXATION = 2.0
"""Upper bound of the relaxation; from here on the iteration need not converge."""
LEAST_WEIGHT_PX = 0.3
"""Offset added to a splat's weight in pixels, so that barely visible splats take little of the
residual.
"""


def colour_correction(colours: Tensor, residuals: Tensor, weights: Tensor, relaxation: float) -> Tensor:
    """Return the correction of `colours` [N, 3], which are displayed clamped at 0.

    Args:
        colours: unclamped colours [N, 3]. Negative ones can rise but do not fall further.
        residuals: [N, 3], sum over tissue pixels of blending weight times (target - picture).
        weights: [N], sum over tissue pixels of blending weight.
        relaxation: share of the mean residual to apply, above 0 and below `MOST_RELAXATION`.

    Returns:
        [N, 3], at most `relaxation` times the largest residual of a pixel, and 0 for splats outside
            the tissue.
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
        """Mask three times, then 0."""

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
