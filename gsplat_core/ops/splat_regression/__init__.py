"""Sums of Gaussian splats at points of 1 to 4 dimensions, with closed-form gradients, compiled."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_float32
from gsplat_core.ops.native import register_gradient

MOST_DIMENSIONS = 4
"""Largest number of dimensions of the points at which a splat regression is evaluated."""


def check_splats(points: Tensor, centres: Tensor, factors: Tensor, values: Tensor) -> None:
    """Check the shapes of points and splats.

    Raises:
        InvalidInput: for wrong shapes or more than `MOST_DIMENSIONS` dimensions.
    """
    if points.dim() != 2 or not 1 <= points.shape[1] <= MOST_DIMENSIONS:
        raise InvalidInput(f"points must be [n, d] with d = 1 to {MOST_DIMENSIONS}, got {list(points.shape)}")
    dims, count = points.shape[1], centres.shape[0] if centres.dim() else -1
    expected = {"centres": (centres, (count, dims)), "factors": (factors, (count, dims, dims))}
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise InvalidInput(f"{name} must be {list(shape)} for {count} splats, got {list(tensor.shape)}")
    if values.dim() != 2 or values.shape[0] != count:
        raise InvalidInput(f"values must be [{count}, m] for {count} splats, got {list(values.shape)}")


def splat_regression(points: Tensor, centres: Tensor, factors: Tensor, values: Tensor) -> Tensor:
    """Evaluate f(x) = Σ v g(x) with g(x) = |det A|⁻¹ (2π)^(-d/2) exp(-|A⁻¹(x - b)|²/2).

    Differentiable in `centres`, `factors` and `values`, but not in `points`. A splat with a singular or non-finite
    factor, centre or value adds nothing and has no gradient. Densities below 2⁻¹²⁶ count as 0. The result does not
    depend on the number of threads.

    Args:
        points: float32 [n, d], d = 1 to 4. The value at a non-finite point is 0.
        centres: b, float32 [k, d].
        factors: A, float32 [k, d, d]; the covariance is A Aᵀ.
        values: v, float32 [k, m], any m.

    Returns:
        float32 [n, m].

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices.
    """
    check_splats(points, centres, factors, values)
    require_float32("splat_regression", points=points, centres=centres, factors=factors, values=values)
    return torch.ops.gsplat_core.splat_regression(points, centres, factors, values)


@torch.library.register_fake("gsplat_core::splat_regression")
def _fake(points: Tensor, centres: Tensor, factors: Tensor, values: Tensor) -> Tensor:
    return points.new_empty(points.shape[0], values.shape[1])


@torch.library.register_fake("gsplat_core::splat_regression_backward")
def _fake_backward(
    points: Tensor, centres: Tensor, factors: Tensor, values: Tensor, gradient: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    return centres.new_empty(centres.shape), factors.new_empty(factors.shape), values.new_empty(values.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    points, centres, factors, values = ctx.saved_tensors
    return None, *torch.ops.gsplat_core.splat_regression_backward(points, centres, factors, values, gradient)


register_gradient("gsplat_core::splat_regression", _backward, setup_context=_setup_context)
