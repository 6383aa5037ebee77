"""Repeated correction of the colours of a picture's splats by its residual, with fixed geometry, on the CPU."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.ops.arguments import check_max_alpha, require_tiled_splats


def correct_colours(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    image: Tensor,
    mask: Tensor,
    *,
    steps: int,
    relaxation: float,
    least_weight: float,
    max_alpha: float = 0.99,
) -> Tensor:
    """Move each colour `steps` times by the weighted mean of the residual over the pixels that show it (SIRT, Gilbert 1972).

    The blending weights are computed once. The result does not depend on the number of threads.

    Args:
        means2d: means [N, 2] in pixels.
        conics: upper triangles [N, 3] of the inverse covariances, 1/pixels².
        colors: colours [N, 3], displayed clamped at 0. Negative ones can rise but do not fall further.
        opacities: opacities [N] in 0..1.
        isect_offsets: int32 [tile_height, tile_width] for tiles of 16 pixels.
        flatten_ids: int32 [M].
        image: target, uint8 RGB [H, W, 3].
        mask: uint8 [H, W]; 0 for pixels that are not compared.
        steps: number of corrections.
        relaxation: share of the mean residual that a step applies.
        least_weight: offset of a splat's weight in pixels, so that barely visible splats take little of the residual.
        max_alpha: upper limit of alpha, from 1/255 to below 1.

    Returns:
        Corrected colours [N, 3]. Splats without a pixel in the mask keep theirs.

    Raises:
        InvalidInput: for wrong shapes, dtypes, devices or limits.
    """
    if image.ndim != 3 or image.shape[2] != 3 or mask.shape != image.shape[:2]:
        raise InvalidInput(f"image must be [H, W, 3] and mask [H, W], got {list(image.shape)} and {list(mask.shape)}")
    if image.dtype != torch.uint8 or mask.dtype != torch.uint8:
        raise InvalidInput(f"image and mask must be uint8, got {image.dtype} and {mask.dtype}")
    require_tiled_splats(
        "correct_colours", (image.shape[1], image.shape[0]), isect_offsets, flatten_ids, opacities,
        means2d=(means2d, 2), conics=(conics, 3), colors=(colors, 3),
    )  # fmt: skip
    if means2d.device.type != "cpu":
        raise InvalidInput(f"correct_colours is for the CPU, got means2d on {means2d.device}")
    if steps < 0:
        raise InvalidInput(f"steps is {steps}; it must be at least 0")
    check_max_alpha(max_alpha)
    return torch.ops.gsplat_core.correct_colours(
        means2d, conics, colors, opacities, isect_offsets, flatten_ids, image, mask, steps, relaxation, least_weight,
        max_alpha,
    )  # fmt: skip


@torch.library.register_fake("gsplat_core::correct_colours")
def _fake(means2d: Tensor, conics: Tensor, colors: Tensor, *_: object) -> Tensor:
    return colors.new_empty(colors.shape)
