"""Structural similarity (Wang et al. 2004) as one fused op, forward and backward."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op

MAX_CHANNELS = 32


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Compute the structural similarity of each pixel and channel (Wang et al. 2004, eq. 13).

    11x11 Gaussian window of sigma 1.5, zero padding, value range 1. Differentiable in both images.

    Args:
        image: float32 [H, W, C] in 0..1, at most 32 channels.
        target: float32 [H, W, C].

    Returns:
        [H, W, C] in -1..1.

    Raises:
        InvalidInput: if shapes differ or a dtype is not float32; `gsplat_core.reference.ssim`
            accepts any floating dtype.
    """
    if image.shape != target.shape or image.ndim != 3 or not 1 <= image.shape[2] <= MAX_CHANNELS:
        raise InvalidInput(
            f"image and target must both be [H, W, C] with 1 to {MAX_CHANNELS} channels,"
            f" got {list(image.shape)} and {list(target.shape)}"
        )
    for name, tensor in (("image", image), ("target", target)):
        if tensor.dtype != torch.float32:
            raise InvalidInput(
                f"{name} must be float32, got {tensor.dtype}; gsplat_core.reference has ssim_map for other types"
            )
    return torch.ops.gsplat_core.ssim_map(image, target)


@torch.library.register_fake("gsplat_core::ssim_map")
def _(image: Tensor, target: Tensor) -> Tensor:
    return torch.empty_like(image, memory_format=torch.contiguous_format)


@torch.library.register_fake("gsplat_core::ssim_map_backward")
def _(gradient: Tensor, image: Tensor, target: Tensor) -> Tensor:
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


torch.library.register_autograd("gsplat_core::ssim_map", _backward, setup_context=_save)
