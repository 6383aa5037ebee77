"""Backward pass of `render_frame` for raw Gaussians and deltas, optionally fused with Adam, and its autograd wrapper.

Formulas: Kerbl et al. 2023, appendix A, with the chain rule through the activations. CUDA only, float32. No call
synchronises with the host, and a CUDA graph can capture both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import GAUSSIAN_TENSORS, View, check_inputs, require_shape
from gsplat_core.ops.native import register_gradient
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION

if TYPE_CHECKING:
    from gsplat_core.ops.frame import Frame

RATES = len(GAUSSIAN_TENSORS)
"""Number of learning rates of the fused Adam: one for each of `GAUSSIAN_TENSORS`."""


class RawGradients(NamedTuple):
    """Gradients of one frame's raw Gaussians, all zero if the frame's lists overflowed."""

    raw: Tensor
    """Gradient [N, 16] in the layout of `scene.gaussians`; equals the gradient of the deltas."""
    sh: Tensor
    """Gradient of `sh` [N, B, 3]; empty for B = 1, where `raw[:, COLOUR]` contains it."""


class GaussianAdam(NamedTuple):
    """State of Adam over the Gaussians (Kingma and Ba 2015).

    Tensors are read on the device, so a captured graph uses new values at each replay.
    """

    first_moments: Sequence[Tensor]
    """First moments of Adam: five contiguous tensors with the Gaussians' shapes and separate memory. The same holds for
    `second_moments`.
    """
    second_moments: Sequence[Tensor]
    rates: Tensor
    """Learning rates in the order of `GAUSSIAN_TENSORS`, float32 [5]."""
    step: Tensor
    """Number of the optimiser step, counted from 1, int64 or int32 [1]; smaller values count as 1."""
    skipped: Tensor
    """Number of rows left unchanged so far because of non-finite gradients, for each tensor, int64 [5]; incremented by
    the step.
    """
    betas: tuple[float, float] = (0.9, 0.999)
    epsilon: float = 1e-8


class ColourCorrection(NamedTuple):
    """Colour update from image residuals in place of a gradient.

    See `gsplat_core.training.steps.photometric`.
    """

    residuals: Tensor
    """Image residuals [H, W, 4]: tissue mask times (target - rendered) for red, green, blue; the fourth channel is the
    tissue mask.
    """
    relaxation: Tensor
    """Share of the mean residual by which colours are corrected, float32 [1]."""


def render_frame_backward(
    gaussians: Sequence[Tensor],
    deltas: Tensor | None,
    view: View,
    forward: Frame,
    v_image: Tensor,
    v_alphas: Tensor | None = None,
    *,
    deterministic: bool = True,
) -> RawGradients:
    """Compute gradients of the raw parameters from dL/dimage and dL/dalphas.

    Camera and background receive no gradient.

    Args:
        gaussians: argument of the `render_frame` call.
        deltas: argument of the `render_frame` call.
        view: argument of the `render_frame` call.
        forward: result of `render_frame` in FrameMode.TRAINING.
        v_image: [H, W, 4], dL/d(red, green, blue, sum of weight times z).
        v_alphas: [H, W], dL/dalphas; None for zero.
        deterministic: bit-identical results. False sums by atomics in the order in which tiles
            finish, and uses 48 B of scratch memory per Gaussian instead of per instance.

    Returns:
        Gradients of the raw parameters.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices.
    """
    _check("render_frame_backward", gaussians, deltas, view, v_image, v_alphas)
    raw, sh = torch.ops.gsplat_core.render_frame_backward(
        list(gaussians), deltas, *view.tensors, list(forward[1:]), v_image, v_alphas, view.eps2d, view.model_index,
        deterministic,
    )  # fmt: skip
    return RawGradients(raw, sh)


def render_frame_backward_adam_(
    gaussians: Sequence[Tensor],
    adam: GaussianAdam,
    deltas: Tensor | None,
    view: View,
    forward: Frame,
    v_image: Tensor,
    v_alphas: Tensor | None = None,
    correction: ColourCorrection | None = None,
    added: Tensor | None = None,
    *,
    needs_raw: bool = True,
    deterministic: bool = True,
) -> Tensor | None:
    """Run `render_frame_backward` and take one Adam step over every Gaussian, in place.

    A Gaussian's row of a tensor and its moments stay unchanged if its gradient, or the square of it, is not finite. If
    the frame's lists overflowed, nothing changes.

    Args:
        gaussians: five contiguous tensors with separate memory.
        adam: optimiser state.
        deltas: argument of the `render_frame` call.
        view: argument of the `render_frame` call.
        forward: result of `render_frame` in FrameMode.TRAINING.
        v_image: [H, W, 4], dL/d(red, green, blue, sum of weight times z).
        v_alphas: [H, W], dL/dalphas; None for zero.
        correction: residuals that replace the colour gradient. Column `COLOUR` of the result is then the colour update,
            and `sh` is not changed. Requires SH degree 0 and a `v_image` with zeros in the last channel.
        added: gradient [N, 16] of further losses by the raw parameters with deltas, added to that of the picture. Its
            colours are ignored.
        needs_raw: return the raw gradients.
        deterministic: as in `render_frame_backward`.

    Returns:
        Raw gradients [N, 16] for a deformation field, with zeros for Gaussians that have a non-finite gradient; None
        unless `needs_raw`.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices.
    """
    _check("render_frame_backward_adam_", gaussians, deltas, view, v_image, v_alphas)
    _check_adam(gaussians, adam)
    residuals, relaxation = correction or (None, None)
    if residuals is not None:
        require_shape("residuals", residuals, (view.height, view.width, 4), "[H, W, 4]")
    if added is not None:
        require_shape("added", added, (len(gaussians[0]), RAW_COLUMNS), "[N, 16]")
    raw: Tensor = torch.ops.gsplat_core.render_frame_backward_adam_(
        list(gaussians), list(adam.first_moments), list(adam.second_moments), adam.rates, adam.step, adam.skipped, deltas,
        *view.tensors, list(forward[1:]), v_image, v_alphas, residuals, relaxation, added, view.eps2d, view.model_index, *adam.betas,
        adam.epsilon, needs_raw, deterministic,
    )  # fmt: skip
    return raw if needs_raw else None


def _check(
    op: str, gaussians: Sequence[Tensor], deltas: Tensor | None, view: View, v_image: Tensor, v_alphas: Tensor | None
) -> None:
    """Check the arguments. The compiled ops check the forward results against the sizes of the arguments."""
    check_inputs(op, gaussians, deltas, view, v_image=v_image, v_alphas=v_alphas)
    require_shape("v_image", v_image, (view.height, view.width, 4), "[H, W, 4]")
    if v_alphas is not None:
        require_shape("v_alphas", v_alphas, (view.height, view.width), "[H, W]")


def _check_adam(gaussians: Sequence[Tensor], adam: GaussianAdam) -> None:
    for kind, moments in (("first moment", adam.first_moments), ("second moment", adam.second_moments)):
        if len(moments) != RATES:
            raise InvalidInput(f"render_frame_backward_adam_ takes {RATES} tensors of {kind}s, got {len(moments)}")
        for parameter, moment in zip(gaussians, moments, strict=True):
            require_shape(f"a {kind}", moment, tuple(parameter.shape), "its parameter's shape")
    require_shape("rates", adam.rates, (RATES,), "one per tensor")
    require_shape("skipped", adam.skipped, (RATES,), "one per tensor")
    step, skipped = adam.step, adam.skipped
    if step.numel() != 1 or step.dtype not in (torch.int32, torch.int64) or skipped.dtype != torch.int64:
        raise InvalidInput(
            f"step must be one int32 or int64 and skipped int64, got {step.dtype} {list(step.shape)} and {skipped.dtype}"
        )


@torch.library.register_fake("gsplat_core::render_frame_backward")
def _backward_fake(gaussians: list[Tensor], *rest: Tensor | float | None) -> tuple[Tensor, Tensor]:
    means, *_, sh = gaussians
    return means.new_empty(means.shape[0], RAW_COLUMNS), torch.empty_like(sh) if sh.shape[1] > 1 else sh.new_empty(0)


@torch.library.register_fake("gsplat_core::render_frame_backward_adam_")
def _backward_adam_fake(gaussians: list[Tensor], *rest: Tensor | float | None) -> Tensor:
    needs_raw = rest[-2]
    return gaussians[0].new_empty(gaussians[0].shape[0], RAW_COLUMNS) if needs_raw else gaussians[0].new_empty(0)


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


register_gradient("gsplat_core::render_frame", _backward, setup_context=_setup_context)
