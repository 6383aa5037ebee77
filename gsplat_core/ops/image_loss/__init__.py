"""Training loss of one frame and its gradients as fused ops, for separate passes and for the fused path on CUDA.

Terms are masked L1 or squared error, SSIM (Wang et al. 2004) and inverse-depth L1 over tissue.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import ImageLoss
from gsplat_core.ops.native import register_gradient
from gsplat_core.ops.ssim import MAX_CHANNELS

STEEP_AS_L1 = 0.01
"""Difference at which the squared error has the slope of L1; `kSteepAsL1` of `image_loss.h`."""


def image_loss(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    depth: Tensor | None = None,
    target_depth: Tensor | None = None,
    ssim_weight: float = 0.0,
    depth_weight: float = 0.0,
    squared: bool = False,
) -> ImageLoss:
    """Compute the photometric and depth loss of a rendered image and its gradients.

    The loss is (1 - ssim_weight) L1 + ssim_weight (1 - SSIM) + depth_weight |1/depth -
    1/target_depth|. Each term is a mean over tissue pixels. SSIM (Wang et al. 2004; 11x11 Gaussian
    window of sigma 1.5, zero padding) is computed on the masked images. The depth term uses tissue
    pixels where both depths are known (> 0). A term without any pixel is 0 and has zero gradient.

    A training step uses `grad_image` and `grad_depth` directly and needs no autograd graph; `loss.backward()` gives the
    same gradients.

    Args:
        image: float32 [H, W, C] in 0..1.
        target: [H, W, C], uint8 (value / 255) or float32.
        mask: [H, W] of any dtype, non-zero = tissue; None = all tissue. Values outside the mask are
            ignored, including NaN.
        depth: float32 [H, W] in mm, 0 = unknown.
        target_depth: float32 [H, W] in mm, 0 = unknown; required with depth.
        ssim_weight: weight 0..1 of the SSIM term; 0 skips its computation.
        depth_weight: weight of the depth term, at least 0.
        squared: use d² / 0.02 of each difference d in place of |d|. Both have the same slope at d =
            0.01, a typical residual of a trained picture.

    Returns:
        Loss, its terms, and the gradients of image and depth.

    Raises:
        InvalidInput: for wrong shapes, dtypes or weights; `gsplat_core.reference.training` accepts float64.
    """
    if image.ndim != 3 or image.shape != target.shape or not 1 <= image.shape[2] <= MAX_CHANNELS:
        raise InvalidInput(
            f"image and target must both be [H, W, C] with 1 to {MAX_CHANNELS} channels,"
            f" got {list(image.shape)} and {list(target.shape)}"
        )
    if target.dtype not in (torch.uint8, torch.float32):
        raise InvalidInput(
            f"target must be uint8 or float32, got {target.dtype}; gsplat_core.reference takes other types"
        )
    if (depth is None) != (target_depth is None):
        raise InvalidInput("depth and target_depth go together: pass both or neither")
    for name, tensor in (("mask", mask), ("depth", depth), ("target_depth", target_depth)):
        if tensor is not None and tensor.shape != image.shape[:2]:
            raise InvalidInput(f"{name} must be [H, W] = {list(image.shape[:2])}, got {list(tensor.shape)}")
    for name, tensor in (("image", image), ("depth", depth), ("target_depth", target_depth)):
        if tensor is not None and tensor.dtype != torch.float32:
            raise InvalidInput(f"{name} must be float32, got {tensor.dtype}; gsplat_core.reference takes other types")
    if not 0 <= ssim_weight <= 1 or not 0 <= depth_weight < float("inf"):
        raise InvalidInput(
            f"ssim_weight must be in 0..1 and depth_weight at least 0, got {ssim_weight} and {depth_weight}"
        )
    if mask is not None and mask.dtype != torch.uint8:
        mask = (mask != 0).view(torch.uint8)
    loss, terms, grad_image, grad_depth = torch.ops.gsplat_core.image_loss(
        image, target, mask, depth, target_depth, ssim_weight, depth_weight, squared
    )
    return ImageLoss(loss, terms, grad_image, None if depth is None else grad_depth)


@torch.library.register_fake("gsplat_core::image_loss")
def _(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None,
    depth: Tensor | None,
    target_depth: Tensor | None,
    ssim_weight: float,
    depth_weight: float,
    squared: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    grad_depth = image.new_empty(0 if depth is None else depth.shape)
    return image.new_empty(()), image.new_empty(3), image.new_empty(image.shape), grad_depth


def _save(
    ctx: torch.autograd.function.FunctionCtx, inputs: tuple, output: tuple[Tensor, Tensor, Tensor, Tensor]
) -> None:
    _, terms, grad_image, grad_depth = output
    ctx.has_depth = inputs[3] is not None  # type: ignore[attr-defined]
    ctx.mark_non_differentiable(terms, grad_image, grad_depth)
    ctx.save_for_backward(grad_image, grad_depth)


def _backward(
    ctx: torch.autograd.function.FunctionCtx, grad_loss: Tensor, *_: Tensor
) -> tuple[Tensor | None, None, None, Tensor | None, None, None, None, None]:
    grad_image, grad_depth = ctx.saved_tensors  # type: ignore[attr-defined]
    return (
        grad_loss * grad_image,
        None,
        None,
        grad_loss * grad_depth if ctx.has_depth else None,  # type: ignore[attr-defined]
        None,
        None,
        None,
        None,
    )


register_gradient("gsplat_core::image_loss", _backward, setup_context=_save)


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
def _frame_loss_fake(
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
