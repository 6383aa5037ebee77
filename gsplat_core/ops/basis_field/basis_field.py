"""Basis-function deformation: bumps in time to per-Gaussian deltas, their gradients, and gradients fused with lazy Adam.

The maths, shapes and truncation are those of `gsplat_core.reference.basis_field`; float32 on the CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.reference.deformation import CHANNEL_GROUPS

CHANNELS = sum(CHANNEL_GROUPS)


def basis_field(centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float) -> Tensor:
    """Deltas [N, 13] at `tau` of bumps with `centers`, `log_widths` [N, B] and `weights` [N, B, 13]; differentiable.

    A bump more than 4 widths away contributes nothing and gets no gradient.
    """
    _check(centers, log_widths, weights)
    return torch.ops.gsplat_core.basis_field(centers, log_widths, weights, tau)


def basis_field_backward(
    gradient: Tensor, centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of (centers, log_widths, weights) for dL/d(delta) `gradient` [N, 13]; exactly zero for inactive bumps."""
    _check(centers, log_widths, weights)
    _check_gradient(gradient, centers)
    return torch.ops.gsplat_core.basis_field_backward(gradient, centers, log_widths, weights, tau)


def basis_field_backward_adam_(
    gradient: Tensor,
    tau: float,
    centers: Tensor,
    log_widths: Tensor,
    weights: Tensor,
    first_moments: Sequence[Tensor],
    second_moments: Sequence[Tensor],
    steps: Tensor,
    learning_rates: Sequence[float],
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-8,
) -> None:
    """Gradients and one lazy Adam step of every bump active at `tau`, in place and in one pass.

    Arguments as `gsplat_core.reference.basis_field_backward_adam_`; every tensor that is updated must be contiguous.
    """
    _check(centers, log_widths, weights)
    _check(*first_moments)
    _check(*second_moments)
    _check_gradient(gradient, centers)
    if steps.shape != centers.shape or steps.dtype != torch.int32:
        raise InvalidInput(f"steps must be int32 {list(centers.shape)}, got {steps.dtype} {list(steps.shape)}")
    if first_moments[0].shape != centers.shape or second_moments[0].shape != centers.shape:
        raise InvalidInput(f"moments must have the shapes of the field's tensors, {list(centers.shape)} and one of 13")
    torch.ops.gsplat_core.basis_field_backward_adam_(
        gradient, tau, centers, log_widths, weights, *first_moments, *second_moments, steps, *learning_rates,
        beta1, beta2, epsilon,
    )  # fmt: skip


def _check(centers: Tensor, log_widths: Tensor, weights: Tensor) -> None:
    shape = tuple(centers.shape)
    if len(shape) != 2 or tuple(log_widths.shape) != shape or tuple(weights.shape) != (*shape, CHANNELS):
        raise InvalidInput(
            f"expected centers [N, B], log_widths [N, B] and weights [N, B, {CHANNELS}], got {list(shape)},"
            f" {list(log_widths.shape)} and {list(weights.shape)}"
        )
    for name, tensor in (("centers", centers), ("log_widths", log_widths), ("weights", weights)):
        if tensor.dtype != torch.float32:
            raise InvalidInput(f"{name} is {tensor.dtype}; this op is float32, gsplat_core.reference has every dtype")


def _check_gradient(gradient: Tensor, centers: Tensor) -> None:
    if gradient.shape != (centers.shape[0], CHANNELS) or gradient.dtype != torch.float32:
        raise InvalidInput(
            f"gradient must be float32 [{centers.shape[0]}, {CHANNELS}], got {gradient.dtype} {list(gradient.shape)}"
        )


@torch.library.register_fake("gsplat_core::basis_field")
def _(centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float) -> Tensor:
    return centers.new_empty(centers.shape[0], CHANNELS)


@torch.library.register_fake("gsplat_core::basis_field_backward")
def _(
    gradient: Tensor, centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float
) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(t.new_empty(t.shape) for t in (centers, log_widths, weights))  # type: ignore[return-value]


@torch.library.register_fake("gsplat_core::basis_field_backward_adam_")
def _(*arguments: Any) -> None:
    return None


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.tau = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
    return *torch.ops.gsplat_core.basis_field_backward(gradient, *ctx.saved_tensors, ctx.tau), None


torch.library.register_autograd("gsplat_core::basis_field", _backward, setup_context=_setup_context)
