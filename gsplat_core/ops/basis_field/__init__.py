"""Basis-function deformation: per-Gaussian deltas from bumps in time, gradients, fused lazy Adam, and changes of the weights
that give wanted deltas or colours at one time.

Maths, shapes and truncation are those of `gsplat_core.reference.basis_field`; float32 on CPU and CUDA. On CUDA the host
does not synchronise. If `tau` and the learning rates are device tensors, a captured launch reads them at every replay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_float32
from gsplat_core.ops.native import register_gradient
from gsplat_core.ops.plain_torch import BASIS_CHANNELS as CHANNELS
from gsplat_core.ops.scalars import store_scalars_
from gsplat_core.scene.gaussians import RAW_COLUMNS

RATES = 6
"""Number of learning rates: position, rotation, log-scale, colour, centres, widths."""


def basis_field(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, padded: bool = False
) -> Tensor:
    """Return the deltas at `tau`; differentiable.

    A bump more than 4 widths away contributes nothing and gets no gradient.

    Args:
        centers: float32 [N, B].
        log_widths: float32 [N, B].
        weights: float32 [N, B, 13].
        tau: normalised time, a number or one float32 on the field's device.
        padded: append three zero columns, the layout that `render_frame` takes.

    Returns:
        Deltas [N, 13], or [N, 16] if padded.
    """
    _check(centers, log_widths, weights)
    return torch.ops.gsplat_core.basis_field(centers, log_widths, weights, _scalars("tau", tau, centers, 1), padded)


def basis_field_backward(
    gradient: Tensor, centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of (centers, log_widths, weights). They are exactly zero for bumps more than 4 widths from `tau`.

    Args:
        gradient: dL/d(deltas) [N, 13], or [N, 16] of which the last three columns are ignored.
        tau: normalised time of the forward pass.
    """
    _check(centers, log_widths, weights)
    _check_gradient(gradient, centers)
    return torch.ops.gsplat_core.basis_field_backward(
        gradient, centers, log_widths, weights, _scalars("tau", tau, centers, 1)
    )


def basis_field_backward_adam_(
    gradient: Tensor,
    tau: float | Tensor,
    field: Sequence[Tensor],
    first_moments: Sequence[Tensor],
    second_moments: Sequence[Tensor],
    steps: Tensor,
    learning_rates: Sequence[float] | Tensor,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
) -> None:
    """Compute gradients and take one lazy Adam step of every bump active at `tau`, in place.

    Arguments are those of `gsplat_core.reference.basis_field_backward_adam_`. Updated tensors must be contiguous.
    `gradient` may be [N, 16]. `tau` and `learning_rates` may be float32 device tensors.
    """
    centers = field[0]
    _check(*field)
    _check(*first_moments)
    _check(*second_moments)
    _check_gradient(gradient, centers)
    if steps.shape != centers.shape or steps.dtype != torch.int32:
        raise InvalidInput(f"steps must be int32 {list(centers.shape)}, got {steps.dtype} {list(steps.shape)}")
    if first_moments[0].shape != centers.shape or second_moments[0].shape != centers.shape:
        raise InvalidInput(f"moments must have the shapes of the field's tensors, {list(centers.shape)} and one of 13")
    torch.ops.gsplat_core.basis_field_backward_adam_(
        gradient, _scalars("tau", tau, centers, 1), *field, *first_moments, *second_moments, steps,
        _scalars("learning_rates", learning_rates, centers, RATES), *betas, epsilon,
    )  # fmt: skip


def basis_field_move_to_(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, target: Tensor
) -> None:
    """Change `weights` minimally in place so that the deltas at `tau` become `target` [N, 13].

    Arguments are those of `gsplat_core.reference.basis_field_move_to_`; `weights` must be contiguous.
    """
    _check(centers, log_widths, weights)
    if target.shape != (centers.shape[0], CHANNELS):
        raise InvalidInput(f"target must be [{centers.shape[0]}, {CHANNELS}], got {list(target.shape)}")
    require_float32("basis_field", centers=centers, target=target)
    torch.ops.gsplat_core.basis_field_move_to_(centers, log_widths, weights, _scalars("tau", tau, centers, 1), target)


def basis_field_add_colours_(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, change: Tensor
) -> None:
    """Change `weights` in place so that the colours at `tau` change by `change` [N, 3].

    Maths and exceptions are those of `gsplat_core.reference.basis_field_add_colours_`. Colours at
    other times change as little as possible.
    """
    _check(centers, log_widths, weights)
    if change.shape != (centers.shape[0], 3):
        raise InvalidInput(f"change must be [{centers.shape[0]}, 3], got {list(change.shape)}")
    require_float32("basis_field_add_colours_", centers=centers, change=change)
    torch.ops.gsplat_core.basis_field_add_colours_(
        centers, log_widths, weights, _scalars("tau", tau, centers, 1), change
    )


def _scalars(name: str, values: float | Sequence[float] | Tensor, like: Tensor, count: int) -> Tensor:
    """Return `count` float32 values on the device of `like`, without waiting for a GPU. Raises InvalidInput."""
    if not isinstance(values, Tensor):
        numbers = [float(v) for v in values] if isinstance(values, Sequence) else [float(values)]
        if len(numbers) != count:
            raise InvalidInput(f"{name} must be {count} numbers, got {len(numbers)}")
        if like.device.type == "cpu":
            return torch.tensor(numbers, dtype=torch.float32)
        to = torch.empty(count, dtype=torch.float32, device=like.device)
        store_scalars_(to, numbers)
        return to
    if values.dtype != torch.float32 or values.numel() != count or values.device != like.device:
        raise InvalidInput(
            f"{name} must be {count} float32 on {like.device}, got {values.dtype} {list(values.shape)} on {values.device}"
        )
    return values


def _check(centers: Tensor, log_widths: Tensor, weights: Tensor) -> None:
    shape = tuple(centers.shape)
    if len(shape) != 2 or tuple(log_widths.shape) != shape or tuple(weights.shape) != (*shape, CHANNELS):
        raise InvalidInput(
            f"expected centers [N, B], log_widths [N, B] and weights [N, B, {CHANNELS}], got {list(shape)},"
            f" {list(log_widths.shape)} and {list(weights.shape)}"
        )
    require_float32("basis_field", centers=centers, log_widths=log_widths, weights=weights)


def _check_gradient(gradient: Tensor, centers: Tensor) -> None:
    shapes = [(centers.shape[0], columns) for columns in (CHANNELS, RAW_COLUMNS)]
    if gradient.shape not in shapes or gradient.dtype != torch.float32:
        raise InvalidInput(
            f"gradient must be float32 {list(shapes[0])} or {list(shapes[1])}, got {gradient.dtype} {list(gradient.shape)}"
        )
    require_float32("basis_field", centers=centers, gradient=gradient)


@torch.library.register_fake("gsplat_core::basis_field")
def _(centers: Tensor, log_widths: Tensor, weights: Tensor, tau: Tensor, padded: bool = False) -> Tensor:
    return centers.new_empty(centers.shape[0], RAW_COLUMNS if padded else CHANNELS)


@torch.library.register_fake("gsplat_core::basis_field_backward")
def _(
    gradient: Tensor, centers: Tensor, log_widths: Tensor, weights: Tensor, tau: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(t.new_empty(t.shape) for t in (centers, log_widths, weights))  # type: ignore[return-value]


@torch.library.register_fake("gsplat_core::basis_field_backward_adam_")
def _(*arguments: Any) -> None:
    return None


@torch.library.register_fake("gsplat_core::basis_field_add_colours_")
def _add_colours_fake(*_: Tensor) -> None:
    return None


@torch.library.register_fake("gsplat_core::basis_field_move_to_")
def _(centers: Tensor, log_widths: Tensor, weights: Tensor, tau: Tensor, target: Tensor) -> None:
    return None


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None]:
    return *torch.ops.gsplat_core.basis_field_backward(gradient, *ctx.saved_tensors), None, None


register_gradient("gsplat_core::basis_field", _backward, setup_context=_setup_context)
