"""What a series of frames keeps of each one's status, without a wait of the host."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op


def count_frame_(status: Tensor, most: Tensor, step: Tensor) -> Tensor:
    """Count a frame by its `status`; returns float32 [1], 1 where its splats fitted its lists and 0 where they were cut.

    Args:
        status: int32 [4] of a `Frame`, on CUDA.
        most: int32 [4]; keeps the largest of every word of the frames' status, but how many of them were cut.
        step: int64 [1]; goes on by one, unless the frame was cut.
    """
    for name, tensor, dtype, size in (
        ("status", status, torch.int32, 4),
        ("most", most, torch.int32, 4),
        ("step", step, torch.int64, 1),
    ):
        require_shape(name, tensor, (size,), "[numbers]")
        if tensor.dtype != dtype or tensor.device != status.device or status.device.type != "cuda":
            raise InvalidInput(f"{name} must be {dtype} on one CUDA device, got {tensor.dtype} on {tensor.device}")
    return torch.ops.gsplat_core.count_frame_(status, most, step)


@torch.library.register_fake("gsplat_core::count_frame_")
def _(status: Tensor, most: Tensor, step: Tensor) -> Tensor:
    return status.new_empty(1, dtype=torch.float32)
