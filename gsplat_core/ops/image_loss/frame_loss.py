"""Training loss of a frame of the fused path, with its gradients, on CUDA."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op


class FrameLoss(NamedTuple):
    """Loss with its gradients, the input of `render_frame_backward`."""

    loss: Tensor
    """Weighted sum of the terms, a scalar."""
    terms: Tensor
    """Terms [3] before weighting: L1 or squared error, 1 - SSIM (0 if unweighted), inverse-depth L1."""
    grad_image: Tensor
    """Gradient of the loss by the rendered image, dL/dimage [H, W, 4]."""
    grad_alphas: Tensor
    """dL/dalphas [H, W]; non-zero only through the depth term."""


def frame_loss(
    image: Tensor,
    alphas: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    target_depth: Tensor | None = None,
    ssim_weight: float = 0.0,
    depth_weight: float = 0.0,
    squared: bool = False,
) -> FrameLoss:
    """Compute `image_loss` for the colours and expected depth of a training frame, without host sync.

    The inputs are those returned by `render_frame` in FrameMode.TRAINING. The expected depth is the last channel
    divided by max(alpha, 1e-10). The function is not differentiable; the gradients are part of the result.

    Args:
        image: float32 [H, W, 4] on CUDA: red, green, blue, and sum of weight times z.
        alphas: float32 [H, W].
        target: uint8 [H, W, 3].
        mask: uint8 [H, W], non-zero = tissue; None = all tissue.
        target_depth: float32 [H, W] in mm, 0 = unknown; None = no depth term.
        ssim_weight: weight 0..1 of the SSIM term; 0 skips its computation.
        depth_weight: weight of the depth term, at least 0.
        squared: quadratic colour term, as in `image_loss`.

    Returns:
        Loss, its terms, and the gradients dL/dimage and dL/dalphas.

    Raises:
        InvalidInput: for wrong shapes, dtypes, devices or weights; `gsplat_core.reference.frame_loss` accepts any
            device and float64.
    """
    if image.ndim != 3 or image.shape[2] != 4 or image.dtype != torch.float32 or not image.is_cuda:
        raise InvalidInput(
            f"image must be float32 [H, W, 4] on a CUDA device, got {image.dtype} {list(image.shape)} on {image.device}"
        )
    size = image.shape[:2]
    wanted = {
        "alphas": (alphas, (*size,), torch.float32),
        "target": (target, (*size, 3), torch.uint8),
        "mask": (mask, (*size,), torch.uint8),
        "target_depth": (target_depth, (*size,), torch.float32),
    }
    for name, (tensor, shape, dtype) in wanted.items():
        if tensor is not None and (tuple(tensor.shape) != shape or tensor.dtype != dtype):
            raise InvalidInput(f"{name} must be {dtype} {list(shape)}, got {tensor.dtype} {list(tensor.shape)}")
    if not 0 <= ssim_weight <= 1 or not 0 <= depth_weight < float("inf"):
        raise InvalidInput(
            f"ssim_weight must be in 0..1 and depth_weight at least 0, got {ssim_weight} and {depth_weight}"
        )
    return FrameLoss(
        *torch.ops.gsplat_core.frame_loss(image, alphas, target, mask, target_depth, ssim_weight, depth_weight, squared)
    )


@torch.library.register_fake("gsplat_core::frame_loss")
def _(
    image: Tensor,
    alphas: Tensor,
    target: Tensor,
    mask: Tensor | None,
    target_depth: Tensor | None,
    ssim_weight: float,
    depth_weight: float,
    squared: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return image.new_empty(()), image.new_empty(3), image.new_empty(image.shape), image.new_empty(image.shape[:2])
