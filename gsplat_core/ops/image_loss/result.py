"""Result type of the image loss, shared by the compiled op and the plain-torch reference."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class ImageLoss(NamedTuple):
    """A loss with its gradients, ready to be fed to the renderer's backward op."""

    loss: Tensor
    """Scalar; differentiable in image and depth."""
    terms: Tensor
    """[3]: L1 or squared error, 1 - SSIM (0 when its weight is 0) and inverse-depth L1, each before its weight. Not differentiable."""
    grad_image: Tensor
    """dL/dimage [H, W, C]. Not differentiable."""
    grad_depth: Tensor | None
    """dL/ddepth [H, W]; None without depth. Not differentiable."""
