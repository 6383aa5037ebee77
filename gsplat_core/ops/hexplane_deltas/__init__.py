"""HexPlane deltas at one time from cached space features, on CUDA as input of `render_frame`.

Maths: `gsplat_core.reference.hexplane_deltas`. The time is read from device memory and the host
does not synchronise, so a CUDA graph can capture the call and replay it with another time.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.scene.gaussians import RAW_COLUMNS


def hexplane_deltas(
    spaces: Sequence[Tensor],
    coordinates: Tensor,
    time: Tensor,
    time_planes: Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    order: Tensor | None = None,
) -> Tensor:
    """Return the HexPlane deltas of the raw parameters of all Gaussians at `time`, for inference.

    Not differentiable. The field is that of Cao & Johnson 2023.

    Args:
        spaces: per level the product of the space planes [N, C] (`hexplane_space`), all float32 or all float16. float16
            halves the memory traffic and rounds features and network to half precision; sums stay float32.
        coordinates: positions in [-1, 1], float32 [N, 4]; the fourth column is not read.
        time: one float32 on the device, clamped to [-1, 1].
        time_planes: xt, yt, zt of every level, float32 [V, U, C].
        weights: weight matrices of the trunk's layers and the head as in `torch.nn.Linear`, with one width and 11
            outputs.
        biases: biases of the same layers.
        order: int32 [N]; row i of `spaces` and `coordinates` belongs to Gaussian order[i]. Spatially sorted rows are
            faster.

    Returns:
        Deltas [N, 16] in the layout of `scene.gaussians`.

    Raises:
        InvalidInput: if the tensors are not on a CUDA device or have an unsupported dtype.
        RuntimeError: if shapes do not match, or the layers exceed the kernel's limits (`takes_layers`).
    """
    if coordinates.device.type != "cuda":
        raise InvalidInput(
            f"hexplane_deltas runs on CUDA and got {coordinates.device}; use hexplane_decode, or gsplat_core.reference"
        )
    kinds = {space.dtype for space in spaces}
    if kinds not in ({torch.float32}, {torch.float16}):
        raise InvalidInput(f"spaces must be all float32 or all float16, got {sorted(map(str, kinds))}")
    for tensor in (coordinates, time, *time_planes, *weights, *biases):
        if tensor.dtype != torch.float32:
            raise InvalidInput(f"got {tensor.dtype}; this op is float32, gsplat_core.reference has every dtype")
    return torch.ops.gsplat_core.hexplane_deltas(
        list(spaces), coordinates, order, time, list(time_planes), list(weights), list(biases)
    )


def padded_width(width: int) -> int:
    """Return the kernels' padded size of a layer of `width`; 0 if it exceeds their limit."""
    return next((size for size in (32, 64, 128) if width <= size), 0)


def takes_layers(channels: int, levels: int, width: int, depth: int, item: int = 4) -> bool:
    """Return True if the kernels support a field of these sizes.

    Args:
        channels: channels of a plane.
        levels: number of resolution levels.
        width: width of the trunk.
        depth: number of layers of the trunk.
        item: bytes per feature: 4 for float32, 2 for float16.
    """
    padded = padded_width(width)
    features = channels * levels
    stride = features if features * item % 128 == 64 else features + 64 // item
    weights = padded * stride + (padded * (depth - 1) + RAW_COLUMNS) * (padded + 32 // item)
    size = weights * item + 4 * (depth * padded + RAW_COLUMNS)
    return channels * item % 64 == 0 and padded > 0 and levels <= 16 and depth <= 9 and size <= 200 * 1024


@torch.library.register_fake("gsplat_core::hexplane_deltas")
def _(
    spaces: list[Tensor],
    coordinates: Tensor,
    order: Tensor | None,
    time: Tensor,
    time_planes: list[Tensor],
    weights: list[Tensor],
    biases: list[Tensor],
) -> Tensor:
    return coordinates.new_empty(coordinates.shape[0], RAW_COLUMNS)
