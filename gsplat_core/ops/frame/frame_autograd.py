"""Autograd for `render_frame`: its raw parameters and deltas get the gradient of `frame_gradients.py`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.scene.layout import COLOUR, LOG_SCALE, OPACITY, POSITION, ROTATION

TENSORS = 9
"""Inputs of the op that are tensors: five of the Gaussians, deltas, viewmat, K, background."""


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    _, alphas, last, *lists = output
    ctx.mark_non_differentiable(last, *lists)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:TENSORS], alphas, last, *lists)
    ctx.width, ctx.height, ctx.eps2d, _, _, ctx.camera_model, _, _, ctx.training = inputs[TENSORS:]


def _backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
    if not ctx.training:
        raise InvalidInput("render_frame keeps what its gradient needs only with training=True; render the frame so")
    if any(ctx.needs_input_grad[6:TENSORS]):
        raise InvalidInput(
            "render_frame has no gradient for the camera and the background; detach them, or use gsplat_core.rasterization"
        )
    *inputs, alphas, last, records, tile_offsets, sorted, splat_starts, instance_splats, status = ctx.saved_tensors
    if v_image is None:
        v_image = alphas.new_zeros(*alphas.shape, 4)
    raw, sh = torch.ops.gsplat_core.render_frame_backward(
        *inputs, records, tile_offsets, sorted, splat_starts, instance_splats, status, alphas, last, v_image, v_alphas,
        ctx.width, ctx.height, ctx.eps2d, ctx.camera_model, True,
    )  # fmt: skip
    # Copies: autograd may add to what it was given, and these would share their memory.
    sh_gradient = raw[:, None, COLOUR] if inputs[4].shape[1] == 1 else sh
    columns = raw[:, POSITION], raw[:, ROTATION], raw[:, LOG_SCALE], raw[:, OPACITY.start], sh_gradient
    own = [column.clone() if needed else None for column, needed in zip(columns, ctx.needs_input_grad, strict=False)]
    return (*own, raw if ctx.needs_input_grad[5] else None, *[None] * 12)


torch.library.register_autograd("gsplat_core::render_frame", _backward, setup_context=_setup_context)
