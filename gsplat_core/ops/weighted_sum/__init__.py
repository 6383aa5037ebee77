"""Sums over splats that do not depend on their order (Hou et al. 2024, "Sort-free Gaussian Splatting via Weighted Sum
Rendering"), compiled.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_float32, require_shape, require_tiled_splats
from gsplat_core.ops.native import register_gradient

MOST_CHANNELS = 32
"""Largest number of channels; `kMostChannels` of `weighted_sum.h`."""
MOST_CHANNEL = 2048.0
"""Absolute value to which the channels of a splat are clamped (`kMostChannel` of `weighted_sum.h`)."""
MOST_TERM = 128.0
"""Absolute value to which a splat's weight times alpha at a pixel is clamped (`kMostTerm` of `weighted_sum.h`)."""


def weighted_sums(
    means2d: Tensor,
    conics: Tensor,
    channels: Tensor,
    opacities: Tensor,
    weights: Tensor,
    width: int,
    height: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> Tensor:
    """Sum t_i c_i and t_i with t_i = w_i o_i exp(-½ Δᵀ Q_i Δ) at every pixel.

    The sums are added in fixed point with a quantum of 2⁻³², so equal splats in another order give the same bytes. A
    splat contributes where both its Gaussian and |o| times its Gaussian are at least 1/255. A splat with a non-finite
    value contributes nothing and gets zero gradients. Differentiable in the first five arguments.

    Args:
        means2d: float32 [N, 2] pixels.
        conics: inverse 2D covariances [N, 3] as xx, xy, yy.
        channels: values [N, D], D up to 32, limited to ±2048.
        opacities: [N], of either sign, not limited to 1.
        weights: [N], of either sign; the product with alpha is limited to ±128.
        width: width of the picture in pixels.
        height: height of the picture in pixels.
        isect_offsets: starts of the tiles' lists of splats, int32 [tile_height, tile_width], for tiles of 16 pixels.
        flatten_ids: lists of splats, int32 [M], from `bin_splats` with the opacities min(1, |o|).

    Returns:
        Planes [D + 1, H, W]: the sums of the channels, and the sum of t_i.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices.
    """
    count = opacities.shape[0] if opacities.dim() == 1 else -1
    if count < 0 or channels.dim() != 2 or not 1 <= channels.shape[1] <= MOST_CHANNELS:
        raise InvalidInput(
            f"weighted_sums takes opacities [N] and channels [N, D] with D from 1 to {MOST_CHANNELS}, got"
            f" {list(opacities.shape)} and {list(channels.shape)}"
        )
    require_float32("weighted_sums", opacities=opacities, weights=weights)
    require_shape("weights", weights, (count,), "[N]")
    require_tiled_splats(
        "weighted_sums", (width, height), isect_offsets, flatten_ids, opacities,
        means2d=(means2d, 2), conics=(conics, 3), channels=(channels, channels.shape[1]),
    )  # fmt: skip
    return torch.ops.gsplat_core.weighted_sums(
        means2d, conics, channels, opacities, weights, isect_offsets, flatten_ids, width, height
    )


@torch.library.register_fake("gsplat_core::weighted_sums")
def _fake(
    means2d: Tensor, conics: Tensor, channels: Tensor, opacities: Tensor, weights: Tensor, isect_offsets: Tensor,
    flatten_ids: Tensor, width: int, height: int,
) -> Tensor:  # fmt: skip
    return means2d.new_empty(channels.shape[1] + 1, height, width)


@torch.library.register_fake("gsplat_core::weighted_sums_backward")
def _fake_backward(
    means2d: Tensor, conics: Tensor, channels: Tensor, opacities: Tensor, weights: Tensor, isect_offsets: Tensor,
    flatten_ids: Tensor, width: int, height: int, v_sums: Tensor,
) -> tuple[Tensor, ...]:  # fmt: skip
    return tuple(tensor.new_empty(tensor.shape) for tensor in (means2d, conics, channels, opacities, weights))


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.size = inputs[7:]
    ctx.save_for_backward(*inputs[:7])


def _backward(ctx: Any, v_sums: Tensor) -> tuple[Tensor | None, ...]:
    gradients = torch.ops.gsplat_core.weighted_sums_backward(*ctx.saved_tensors, *ctx.size, v_sums)
    return *gradients, None, None, None, None


register_gradient("gsplat_core::weighted_sums", _backward, setup_context=_setup_context)
