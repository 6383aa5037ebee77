"""Evaluation of real spherical harmonics, compiled (Sloan 2013, "Efficient SH Evaluation")."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.arguments import check_spherical_harmonics_arguments, require_float32
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import register_gradient


@in_plain_mode
def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Evaluate spherical harmonics in given directions, as gsplat 1.5.3.

    Returns the plain sum, without the offset of 0.5 that makes it a colour. Differentiable in dirs and coeffs.

    Args:
        degrees_to_use: degree, 0 to 4.
        dirs: float32 [..., 3], of any non-zero length.
        coeffs: float32 [..., K, 3] with K >= (degrees_to_use + 1)². Leading dimensions may broadcast to those of dirs,
            which avoids a copy per camera.
        masks: bool [...]; where false, the result and its gradients are 0 and nothing is computed.

    Returns:
        Colours [..., 3].

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices.
    """
    check_spherical_harmonics_arguments(degrees_to_use, dirs, coeffs, masks)
    require_float32("spherical_harmonics", dirs=dirs, coeffs=coeffs)
    leading, bases = dirs.shape[:-1], coeffs.shape[-2]
    shared = coeffs.dim() - 2
    if coeffs.shape[:-2] != leading[len(leading) - shared :]:
        coeffs, shared = coeffs.expand(*leading, bases, 3), len(leading)
    sets = math.prod(leading[len(leading) - shared :])
    rows = math.prod(leading[: len(leading) - shared])
    colors = torch.ops.gsplat_core.spherical_harmonics(
        degrees_to_use,
        dirs.reshape(rows, sets, 3),
        coeffs.reshape(sets, bases, 3),
        None if masks is None else masks.expand(leading).reshape(rows, sets),
    )
    return colors.reshape(dirs.shape)


@torch.library.register_fake("gsplat_core::spherical_harmonics")
def _fake(degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None) -> Tensor:
    return dirs.new_empty(dirs.shape)


@torch.library.register_fake("gsplat_core::spherical_harmonics_backward")
def _fake_backward(
    degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None, v_colors: Tensor, needs_dirs: bool
) -> tuple[Tensor, Tensor]:
    return dirs.new_empty(tuple(dirs.shape) if needs_dirs else (0,)), coeffs.new_empty(coeffs.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.degree = inputs[0]
    ctx.save_for_backward(*inputs[1:])


def _backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
    dirs, coeffs, masks = ctx.saved_tensors
    v_dirs, v_coeffs = torch.ops.gsplat_core.spherical_harmonics_backward(
        ctx.degree, dirs, coeffs, masks, v_colors, ctx.needs_input_grad[1]
    )
    return None, v_dirs if ctx.needs_input_grad[1] else None, v_coeffs, None


register_gradient("gsplat_core::spherical_harmonics", _backward, setup_context=_setup_context)
