"""Structural similarity (Wang et al. 2004) as one fused op, forward and backward."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import differentiable_once, register_gradient

MAX_CHANNELS = 32
WINDOW_RADIUS_PX = 5
"""Radius of the SSIM window in pixels: width of the picture's border where the window reaches into the zero padding."""


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Compute the structural similarity of each pixel and channel (Wang et al. 2004, eq. 13).

    11x11 Gaussian window of sigma 1.5, zero padding, value range 1. Differentiable in both images.

    Args:
        image: float32 [H, W, C] in 0..1, at most 32 channels.
        target: float32 [H, W, C].

    Returns:
        [H, W, C] in -1..1.

    Raises:
        InvalidInput: if shapes differ or a dtype is not float32; `gsplat_core.reference.training`
            accepts any floating dtype.
    """
    if image.shape != target.shape or image.ndim != 3 or not 1 <= image.shape[2] <= MAX_CHANNELS:
        raise InvalidInput(
            f"image and target must both be [H, W, C] with 1 to {MAX_CHANNELS} channels,"
            f" got {list(image.shape)} and {list(target.shape)}"
        )
    _require_float32(image, target)
    return torch.ops.gsplat_core.ssim_map(image, target)


def _require_float32(image: Tensor, target: Tensor) -> None:
    for name, tensor in (("image", image), ("target", target)):
        if tensor.dtype != torch.float32:
            raise InvalidInput(
                f"{name} must be float32, got {tensor.dtype}; gsplat_core.reference has ssim_map for other types"
            )


@in_plain_mode
def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Compute the mean structural similarity of pictures, with the signature of the package `fused-ssim`.

    Args:
        img1: pictures float32 [B, C, H, W] in 0..1; differentiable.
        img2: pictures of the same shape; differentiable.
        padding: "same" averages all pixels, "valid" those at least 5 pixels from the border.
        train: False computes no gradient.

    Returns:
        Mean over all pictures, channels and pixels, [].

    Raises:
        InvalidInput: for other shapes, dtypes or paddings, or pictures without a valid pixel.
    """
    if padding not in ("same", "valid"):
        raise InvalidInput(f"padding is {padding!r}; choose 'same' or 'valid'")
    border = 0 if padding == "same" else WINDOW_RADIUS_PX
    if img1.dim() != 4 or img1.shape != img2.shape or min(img1.shape[2:]) <= 2 * border or not img1.numel():
        raise InvalidInput(
            f"fused_ssim takes two tensors [B, C, H, W] larger than {2 * border} pixels, got {list(img1.shape)} and"
            f" {list(img2.shape)}"
        )
    _require_float32(img1, img2)
    if not train:
        img1, img2 = img1.detach(), img2.detach()
    channels = img1.shape[0] * img1.shape[1]
    if channels <= MAX_CHANNELS:
        return _Mean.apply(img1, img2, border)
    total = img1.new_zeros(())
    for one, other in zip(*(each.flatten(0, 1).split(MAX_CHANNELS) for each in (img1, img2)), strict=True):
        total = total + _Mean.apply(one, other, border) * (len(one) / channels)
    return total


class _Mean(Function):
    """Mean similarity of at most 32 channels [..., H, W] without a border in pixels: one compiled call per direction."""

    @staticmethod
    def forward(ctx: Any, img1: Tensor, img2: Tensor, border: int) -> Tensor:
        image, target = (each.flatten(0, -3).permute(1, 2, 0).contiguous() for each in (img1, img2))
        ctx.save_for_backward(image, target)
        ctx.border, ctx.shape = border, img1.shape
        return torch.ops.gsplat_core.ssim_mean(image, target, border)

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        image, target = ctx.saved_tensors
        needs_image, needs_target, _ = ctx.needs_input_grad

        def derivative(one: Tensor, other: Tensor) -> Tensor:
            found: Tensor = torch.ops.gsplat_core.ssim_mean_backward(gradient, one, other, ctx.border)
            return found.permute(2, 0, 1).view(ctx.shape)

        # SSIM is symmetric, so the target's gradient is that of the image with both exchanged.
        return (
            derivative(image, target) if needs_image else None,
            derivative(target, image) if needs_target else None,
            None,
        )


@torch.library.register_fake("gsplat_core::ssim_map")
def _(image: Tensor, target: Tensor) -> Tensor:
    return torch.empty_like(image, memory_format=torch.contiguous_format)


@torch.library.register_fake("gsplat_core::ssim_map_backward")
def _(gradient: Tensor, image: Tensor, target: Tensor) -> Tensor:
    return torch.empty_like(image, memory_format=torch.contiguous_format)


@torch.library.register_fake("gsplat_core::ssim_mean")
def _(image: Tensor, target: Tensor, border: int) -> Tensor:
    return image.new_empty(())


@torch.library.register_fake("gsplat_core::ssim_mean_backward")
def _(gradient: Tensor, image: Tensor, target: Tensor, border: int) -> Tensor:
    return torch.empty_like(image, memory_format=torch.contiguous_format)


def _save(ctx: torch.autograd.function.FunctionCtx, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: torch.autograd.function.FunctionCtx, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
    image, target = ctx.saved_tensors  # type: ignore[attr-defined]
    needs_image, needs_target = ctx.needs_input_grad  # type: ignore[attr-defined]
    backward = torch.ops.gsplat_core.ssim_map_backward
    # SSIM is symmetric, so the target's gradient is that of the image with both exchanged.
    return (
        backward(gradient, image, target) if needs_image else None,
        backward(gradient, target, image) if needs_target else None,
    )


register_gradient("gsplat_core::ssim_map", _backward, setup_context=_save)
