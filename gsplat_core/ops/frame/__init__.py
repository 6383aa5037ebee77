"""Ops `render_frame` and `render_weighted_frame`: a whole frame on CUDA, from raw Gaussians to the image, in a few launches
without host synchronisation.

The steps are deform, activate, project, sort and blend. Splatting follows Kerbl et al. 2023 and Zwicker et al. 2001,
with the same picture as `gsplat_core.rasterization`. A frame of weighted sums (Hou et al. 2024) needs neither sorting nor
blending in order. An instance is a pair of a splat and a tile that it touches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native
from gsplat_core.ops.arguments import GAUSSIAN_TENSORS, View, check_inputs, require_shape
from gsplat_core.rendering.settings import TILE_SIZE

__all__ = [
    "GAUSSIAN_TENSORS",
    "MAX_SEGMENT",
    "STATUS_LONGEST",
    "STATUS_NEEDED",
    "STATUS_OVERFLOW",
    "Frame",
    "FrameMode",
    "View",
    "WeightedFrame",
    "accumulate_status_",
    "render_frame",
    "render_weighted_frame",
]

OPACITY_BASES = 16
"""Harmonics of a Gaussian's opacity in a frame of weighted sums: degree 3."""
MAX_SEGMENT = 1024
"""Largest capacity of the buffer segment of one tile in `FrameMode.SEGMENTS`, in instances (pairs of splat and tile)."""
STATUS_NEEDED, STATUS_LONGEST, STATUS_OVERFLOW = range(3)
"""Indices into `Frame.status`: number of instances of the frame, largest number in a tile, and 1 if instances were
dropped.
"""


class FrameMode(IntEnum):
    """Purpose of a frame, which determines the layout of its tile lists."""

    SHARED = 0
    """Mode for a picture whose tile lists, of any length, are stored consecutively in one buffer of `capacity` instances."""
    TRAINING = 1
    """Mode for a training step. Tile lists are stored as in SHARED. The frame also has the values that the backward pass needs,
    and its depth is the sum of weight times z.
    """
    SEGMENTS = 2
    """Mode for a picture in which every tile's list has its own segment of the buffer, with space for `capacity`
    instances.

    `capacity` is at most MAX_SEGMENT. A frame takes two kernel launches instead of four, because no prefix sum over
    the list lengths is needed. The buffer takes 8 bytes for each of tiles x `capacity` instances, used or not.
    """


class Frame(NamedTuple):
    """Rendered frame and the values needed by its backward pass."""

    image: Tensor
    """[H, W, 4]: red, green, blue over the background, and depth.

    Depth is the weighted mean of z, or the weighted sum when training.
    """
    alphas: Tensor
    """Accumulated opacity [H, W]."""
    last: Tensor
    """Index in `sorted` of the last instance blended in each pixel, int32 [H, W]; -1 for none. Empty unless training."""
    records: Tensor
    """Projected splats [N, 12] in the kernels' format; rows of culled Gaussians are undefined.

    A colour of exactly 0 was clamped. Columns: x, y, coefficients of log2 alpha (xx, xy, yy, 1),
    infinity, red, green, blue, z, 0.
    """
    tile_offsets: Tensor
    """Index in `sorted` of the first instance of each tile, int32 [tiles + 1]. Empty in `FrameMode.SEGMENTS`."""
    sorted: Tensor
    """Instances sorted by tile and depth, int32 [capacity]. Empty unless training; may contain -1 if the lists
    overflowed.
    """
    splat_starts: Tensor
    """Number of each splat's first instance (pair of splat and tile), int32 [N + 1]. Empty unless training."""
    instance_splats: Tensor
    """Index of the splat of each instance (pair of splat and tile), int32 [capacity]. Empty unless training."""
    status: Tensor
    """Frame status, int32 [4], indexed by `STATUS_NEEDED` and the following constants. Reading it synchronises with the
    host.
    """


def render_frame(
    gaussians: Sequence[Tensor],
    deltas: Tensor | None,
    view: View,
    capacity: int,
    mode: FrameMode = FrameMode.SHARED,
) -> Frame:
    """Render N Gaussians, given by their raw parameters, for one camera.

    With float16 `sh` (not when training), blending runs in half precision on the tensor cores. This is faster and
    nearly the same picture. Colours saturate at 65,504, and splats thinner than 0.01 pixel (with `eps2d` 0) are culled.
    All other arithmetic is float32.

    The picture is that of `gsplat_core.reference.render_frame`. Gaussians with a non-finite value or a zero-length
    rotation are culled. The host does not synchronise, and torch allocates all memory, so a CUDA graph can capture the
    call. The view's tensors and the deltas are read on the device at each replay. Equal inputs give bit-identical
    results.

    Args:
        gaussians: float32 on CUDA: means [N, 3], quats [N, 4] (wxyz, non-zero), log_scales [N, 3], logit_opacities [N],
            and sh [N, B, 3] with B = (degree + 1)², degree at most 4.
        deltas: [N, 16], added to the raw parameters in the layout of `gsplat_core.scene.gaussians`, or None.
        view: camera with its tensors on the device.
        capacity: allocated instances, in all tiles together or, with segments, in each tile. If a frame needs more,
            `status` reports how many, and the picture is invalid. Render again with at least as many.
        mode: purpose of the frame.

    Returns:
        Frame with image, alphas and status.

    Raises:
        InvalidInput: for other devices, dtypes or shapes.
    """
    if capacity < 1:
        raise InvalidInput(f"capacity must be at least 1 instance, got {capacity}")
    if mode == FrameMode.SEGMENTS and capacity > MAX_SEGMENT:
        raise InvalidInput(
            f"a tile's own segment holds at most {MAX_SEGMENT} instances, got {capacity}; use FrameMode.SHARED"
        )
    check_inputs("render_frame", gaussians, deltas, view, half_sh=mode != FrameMode.TRAINING)
    if native.CUDA_MISSING is not None:
        raise InvalidInput(f"render_frame needs the CUDA kernels, which are {native.CUDA_MISSING}")
    return Frame(
        *torch.ops.gsplat_core.render_frame(
            list(gaussians), deltas, *view.tensors, view.width, view.height, view.eps2d, view.near_plane, view.far_plane,
            view.model_index, capacity, mode,
        )
    )  # fmt: skip


class WeightedFrame(NamedTuple):
    """Rendered frame of weighted sums."""

    image: Tensor
    """[H, W, 4]: red, green, blue, and the mean of z by weight; 0 where the weights are too small."""
    alphas: Tensor
    """Share of the splats' weights in all weights [H, W]."""
    status: Tensor
    """Frame status as `Frame.status`."""


def render_weighted_frame(
    gaussians: Sequence[Tensor],
    opacity_harmonics: Tensor,
    factors: Tensor,
    scalars: tuple[Tensor, Tensor, Tensor],
    view: View,
    capacity: int,
    *,
    least_total: float,
    least_share: float,
) -> WeightedFrame:
    """Render N Gaussians by weighted sums (Hou et al. 2024) with the weights ω = v max(0, 1 - z/σ), without gradients.

    The picture is that of `gsplat_core.rendering.weighted_sum.WeightedSumRenderer`: at a pixel the sum of a ω c over the sum
    of a ω, each with the background's. A splat's `a` is its opacity, a sum of harmonics of the view direction, times its
    Gaussian. It contributes where both are at least 1/255.

    Terms and channels are rounded to multiples of 2⁻²⁴ and 2⁻¹⁸, and their products are added as integers: Gaussians in
    another order give the same bytes. A splat's largest term is limited to ±127, its channels to 2048. In tiles with more
    than 2¹⁷ splats terms are rounded more coarsely, so that a sum of channels is correct as long as the mean of |term
    channel| over the tile's splats is below 16. Gaussians with a non-finite value are culled. The host does not synchronise.

    Args:
        gaussians: as in `render_frame`; logit_opacities are not used, but must be finite.
        opacity_harmonics: float32 [N, 16], harmonics of degree 3.
        factors: float32 [N], v.
        scalars: σ, the unit in which depths are added, and the weight of the background, each one number on the device.
        view: camera with its tensors on the device.
        capacity: as in `render_frame` with `FrameMode.SHARED`.
        least_total: lower limit of the sum of all weights at a pixel.
        least_share: sum of the splats' weights up to which a pixel has no depth (0).

    Raises:
        InvalidInput: for other devices, dtypes or shapes.
    """
    if capacity < 1:
        raise InvalidInput(f"capacity must be at least 1 instance, got {capacity}")
    sigma, distance, behind = scalars
    check_inputs(
        "render_weighted_frame", gaussians, None, view,
        opacity_harmonics=opacity_harmonics, factors=factors, sigma=sigma, distance=distance, behind=behind,
    )  # fmt: skip
    count = gaussians[0].shape[0]
    require_shape("opacity_harmonics", opacity_harmonics, (count, OPACITY_BASES), "[N, 16]")
    require_shape("factors", factors, (count,), "[N]")
    for name, scalar in (("sigma", sigma), ("distance", distance), ("behind", behind)):
        if scalar.numel() != 1:
            raise InvalidInput(f"{name} must be one number, got {list(scalar.shape)}")
    if native.CUDA_MISSING is not None:
        raise InvalidInput(f"render_weighted_frame needs the CUDA kernels, which are {native.CUDA_MISSING}")
    return WeightedFrame(
        *torch.ops.gsplat_core.render_weighted_frame(
            list(gaussians), opacity_harmonics, factors, list(scalars), *view.tensors, view.width, view.height,
            view.eps2d, view.near_plane, view.far_plane, view.model_index, least_total, least_share, capacity,
        )
    )  # fmt: skip


def accumulate_status_(status: Tensor, totals: Tensor, step: Tensor) -> Tensor:
    """Merge a frame's status into the totals of a series of frames, on the device.

    Args:
        status: int32 [4] of a `Frame`, on CUDA.
        totals: int32 [4]; receives the maximum of every entry, but in STATUS_OVERFLOW the number of overflowed frames.
        step: int64 [1]; incremented unless the frame overflowed.

    Returns:
        float32 [1]: 0 if the frame overflowed, otherwise 1.
    """
    for name, tensor, dtype, size in (
        ("status", status, torch.int32, 4),
        ("totals", totals, torch.int32, 4),
        ("step", step, torch.int64, 1),
    ):
        require_shape(name, tensor, (size,), "[numbers]")
        if tensor.dtype != dtype or tensor.device != status.device or status.device.type != "cuda":
            raise InvalidInput(f"{name} must be {dtype} on one CUDA device, got {tensor.dtype} on {tensor.device}")
    return torch.ops.gsplat_core.accumulate_status_(status, totals, step)


@torch.library.register_fake("gsplat_core::render_frame")
def _render_frame_fake(gaussians: list[Tensor], *rest: Tensor | float | None) -> tuple[Tensor, ...]:
    *_, width, height, _eps2d, _near_plane, _far_plane, _camera_model, capacity, mode = rest
    means = gaussians[0]
    n = means.shape[0]
    assert isinstance(width, int) and isinstance(height, int) and isinstance(capacity, int)
    tiles = math.ceil(width / TILE_SIZE) * math.ceil(height / TILE_SIZE)
    training = mode == FrameMode.TRAINING

    def ints(*shape: int) -> Tensor:
        return means.new_empty(shape, dtype=torch.int32)

    return (
        means.new_empty((height, width, 4)),
        means.new_empty((height, width)),
        ints(height, width) if training else ints(0, 0),
        means.new_empty((n, 12)),
        ints(0 if mode == FrameMode.SEGMENTS else tiles + 1),
        ints(capacity if training else 0),
        ints(n + 1 if training else 0),
        ints(capacity if training else 0),
        ints(4),
    )


@torch.library.register_fake("gsplat_core::render_weighted_frame")
def _render_weighted_frame_fake(gaussians: list[Tensor], *rest: Tensor | float | None) -> tuple[Tensor, ...]:
    width, height = rest[6:8]
    means = gaussians[0]
    assert isinstance(width, int) and isinstance(height, int)
    return (
        means.new_empty((height, width, 4)),
        means.new_empty((height, width)),
        means.new_empty(4, dtype=torch.int32),
    )


@torch.library.register_fake("gsplat_core::accumulate_status_")
def _accumulate_status_fake(status: Tensor, totals: Tensor, step: Tensor) -> Tensor:
    return status.new_empty(1, dtype=torch.float32)
