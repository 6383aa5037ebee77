"""Autograd wrapper of `render_frame`, with gradients of raw parameters and deltas."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, ROTATION

TRAINING = 1
"""Value of `FrameMode.TRAINING`, duplicated here to avoid a circular import."""


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    (
        gaussians,
        deltas,
        viewmat,
        intrinsics,
        background,
        _width,
        _height,
        eps2d,
        _near,
        _far,
        camera_model,
        _capacity,
        mode,
    ) = inputs
    _image, alphas, *rest = output
    ctx.mark_non_differentiable(*rest)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*gaussians, deltas, viewmat, intrinsics, background, alphas, *rest)
    ctx.eps2d, ctx.camera_model, ctx.training = eps2d, camera_model, mode == TRAINING


def _backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None, *_: Any) -> tuple[Any, ...]:
    if not ctx.training:
        raise InvalidInput("render_frame keeps what its gradient needs in FrameMode.TRAINING only; render the frame so")
    of_gaussians, of_deltas, *of_view = ctx.needs_input_grad[:5]
    if any(of_view):
        raise InvalidInput(
            "render_frame has no gradient for the camera and the background; detach them, or use gsplat_core.rasterization"
        )
    saved = ctx.saved_tensors
    gaussians, (deltas, *view), forward = saved[:5], saved[5:9], saved[9:]
    if v_image is None:
        v_image = forward[0].new_zeros(*forward[0].shape, 4)
    raw, sh = torch.ops.gsplat_core.render_frame_backward(
        list(gaussians), deltas, *view, list(forward), v_image, v_alphas, ctx.eps2d, ctx.camera_model, True
    )
    # Return copies, because autograd may accumulate in place and these views share memory.
    sh_gradient = raw[:, None, COLOUR] if gaussians[4].shape[1] == 1 else sh
    columns = raw[:, POSITION], raw[:, ROTATION], raw[:, LOG_SCALE], raw[:, OPACITY.start], sh_gradient
    own = [column.clone() if needed else None for column, needed in zip(columns, of_gaussians, strict=True)]
    return own, raw if of_deltas else None, *[None] * 11


torch.library.register_autograd("gsplat_core::render_frame", _backward, setup_context=_setup_context)
