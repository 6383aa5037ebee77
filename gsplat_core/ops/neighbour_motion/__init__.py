"""Affine motion around points from the motion of their neighbours, compiled, for the CPU, with gradients.

`gsplat_core.rendering.flow.deformation_gradients` computes it in plain torch for any floating dtype and device.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_float32, require_shape
from gsplat_core.ops.native import register_gradient


def neighbour_motion(before: Tensor, after: Tensor, turned: Tensor, neighbours: Tensor, stiffness: float) -> Tensor:
    """Return the matrices F of the least-squares affine motion around N points (CPU).

    F = (Σ d2 d1ᵀ / s + stiffness R) (Σ d1 d1ᵀ / s + stiffness I)⁻¹ with d1 and d2 the offsets of the neighbours at both
    times and s = Σ |d1|². F = R without neighbours, or with all of them at the point. Differentiable in `after` and
    `turned`. The result does not depend on the number of threads.

    Args:
        before: float32 [N, 3], positions at the first time.
        after: float32 [N, 3], positions at the second time.
        turned: float32 [N, 3, 3], the rotation R of each point.
        neighbours: int32 [N, K], indices of points.
        stiffness: weight of the rotation.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices.
    """
    require_float32("neighbour_motion", before=before, after=after, turned=turned)
    if before.device.type != "cpu":
        raise InvalidInput(f"neighbour_motion is for the CPU, got points on {before.device}; use deformation_gradients")
    count = before.shape[0] if before.ndim else -1
    require_shape("before", before, (count, 3), "[N, 3]")
    require_shape("after", after, (count, 3), "[N, 3]")
    require_shape("turned", turned, (count, 3, 3), "[N, 3, 3]")
    if neighbours.dtype != torch.int32 or neighbours.ndim != 2 or neighbours.shape[0] != count:
        raise InvalidInput(
            f"neighbours must be int32 [N, K] with N = {count}, got {neighbours.dtype} {list(neighbours.shape)}"
        )
    return torch.ops.gsplat_core.neighbour_motion(before.detach(), after, turned, neighbours, stiffness)


@torch.library.register_fake("gsplat_core::neighbour_motion")
def _fake(before: Tensor, after: Tensor, turned: Tensor, neighbours: Tensor, stiffness: float) -> Tensor:
    return turned.new_empty(turned.shape)


@torch.library.register_fake("gsplat_core::neighbour_motion_backward")
def _backward_fake(before: Tensor, neighbours: Tensor, stiffness: float, v_out: Tensor) -> tuple[Tensor, Tensor]:
    return before.new_empty(before.shape), v_out.new_empty(v_out.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    before, _, _, neighbours, ctx.stiffness = inputs
    ctx.save_for_backward(before, neighbours)


def _backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:
    before, neighbours = ctx.saved_tensors
    v_after, v_turned = torch.ops.gsplat_core.neighbour_motion_backward(before, neighbours, ctx.stiffness, v_out)
    return None, v_after, v_turned, None, None


register_gradient("gsplat_core::neighbour_motion", _backward, setup_context=_setup_context)
