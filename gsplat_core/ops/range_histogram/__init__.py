"""Histograms of the depth that a range sensor measures, one per column of a picture, with gradients (Z-Splat, Qu et al. 2024)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import check_max_alpha, require_float32, require_tiled_splats
from gsplat_core.ops.native import register_gradient
from gsplat_core.ops.splat_rays import RAY_NUMBERS

MOST_BINS = 65536
"""Maximum number of bins of a histogram."""


class Bins(NamedTuple):
    """Depth bins of equal width in which a range sensor's histogram counts."""

    nearest: float
    """Depth at the first edge, in the scene's unit."""
    width: float
    """Width of a bin in the scene's unit."""
    number: int


def range_histogram(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    bins: Bins,
    image_width: int,
    image_height: int,
    *,
    factors: Tensor | None = None,
    max_alpha: float = 0.99,
) -> Tensor:
    """Sum, per column of the picture and bin, the blending weights of the depths in the bin.

    A splat with blending weight w in a pixel adds w (Φ((z₁ - t)/s) - Φ((z₀ - t)/s)) to the bin from z₀ to z₁. Its depth t and
    standard deviation s along the pixel's ray follow from `rays`. Weights are those of `rasterize_to_pixels`. Parts of a
    splat beyond 4.5 s are left out. Differentiable in the first four arguments. The result does not depend on the number of
    threads, and is the same in each run on CUDA.

    Args:
        means2d: means [N, 2] in pixels.
        conics: upper triangles [N, 3] of the inverse covariances, 1/pixels².
        opacities: opacities [N] in 0..1.
        rays: ray coefficients [N, 10] from `splat_rays`. Splats with a non-finite value are skipped.
        isect_offsets: int32 [tile_height, tile_width] for tiles of 16 pixels.
        flatten_ids: int32 [M].
        bins: bins of the histograms.
        image_width: width in pixels.
        image_height: height in pixels.
        factors: [H, W], factor of t and s in each pixel: 1 for depth, |ray| for distance, 0 for pixels to leave out. None
            for 1.
        max_alpha: upper limit of alpha, from 1/255 to below 1.

    Returns:
        float32 [image_width, bins.number].

    Raises:
        InvalidInput: for wrong shapes, dtypes, bins or limits.
    """
    require_tiled_splats(
        "range_histogram", (image_width, image_height), isect_offsets, flatten_ids, opacities,
        means2d=(means2d, 2), conics=(conics, 3), rays=(rays, RAY_NUMBERS),
    )  # fmt: skip
    require_float32("range_histogram", opacities=opacities, factors=factors)
    if factors is not None and tuple(factors.shape) != (image_height, image_width):
        raise InvalidInput(f"factors must be [{image_height}, {image_width}], got {list(factors.shape)}")
    if not (1 <= bins.number <= MOST_BINS and bins.width > 0):
        raise InvalidInput(f"bins must be 1 to {MOST_BINS} of positive width, got {bins.number} of {bins.width}")
    check_max_alpha(max_alpha)
    return torch.ops.gsplat_core.range_histogram(
        means2d,
        conics,
        opacities,
        rays,
        isect_offsets,
        flatten_ids,
        factors,
        *bins,
        image_width,
        image_height,
        max_alpha,
    )


@torch.library.register_fake("gsplat_core::range_histogram")
def _fake(means2d: Tensor, *rest: Any) -> Tensor:
    *_, bins, width, _height, _max_alpha = rest if len(rest) == 12 else (*rest, 0.99)
    return means2d.new_empty(width, bins)


@torch.library.register_fake("gsplat_core::range_histogram_backward")
def _fake_backward(
    means2d: Tensor, conics: Tensor, opacities: Tensor, rays: Tensor, *rest: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return tuple(t.new_empty(t.shape) for t in (means2d, conics, opacities, rays))  # type: ignore[return-value]


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:7])
    ctx.rest = inputs[7:]


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    gradients = torch.ops.gsplat_core.range_histogram_backward(*ctx.saved_tensors, gradient, *ctx.rest)
    return (*gradients, *[None] * (3 + len(ctx.rest)))


register_gradient("gsplat_core::range_histogram", _backward, setup_context=_setup_context)
