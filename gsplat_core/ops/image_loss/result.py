"""Result type of the image loss, shared by the compiled op and the plain-torch reference."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class ImageLoss(NamedTuple):
    """Image loss with its gradients, the input of the renderer's backward op."""

    loss: Tensor
    """Weighted sum of the loss terms, scalar; differentiable in image and depth."""
    terms: Tensor
    """Terms [3] before weighting: L1 or squared error, 1 - SSIM (0 if unweighted), inverse-depth L1.

    Not differentiable.
    """
    grad_image: Tensor
    """Gradient of the loss by the image, dL/dimage [H, W, C]. Not differentiable."""
    grad_depth: Tensor | None
    """dL/ddepth [H, W]; None without depth. Not differentiable."""
