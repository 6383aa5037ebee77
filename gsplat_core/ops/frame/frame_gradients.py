"""The gradient of `render_frame` with respect to raw Gaussians and their deltas, and the same with Adam over the Gaussians.

Formulas of Kerbl et al. 2023, appendix A, taken back through the activations; CUDA only, float32. Neither waits for the device, and
both can be captured in a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_float32, require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.rendering.settings import EPS2D
from gsplat_core.scene.cameras import CAMERA_MODELS
from gsplat_core.scene.layout import RAW_COLUMNS

if TYPE_CHECKING:
    from gsplat_core.ops.frame.frame import Frame

RATES = 5
"""Learning rates of the fused Adam: means, quats, log-scales, logit opacities, spherical harmonics."""


class RawGradients(NamedTuple):
    """Gradients of one frame's raw Gaussians, all zero where the frame's lists were cut (`status[2]`)."""

    raw: Tensor
    """[N, 16] in the layout of `scene.layout`, which is that of the deltas, whose gradient it is too."""
    sh: Tensor
    """[N, B, 3]; empty for B = 1, where `raw[:, COLOUR]` is all there is."""


def render_frame_backward(
    gaussians: Sequence[Tensor],
    deltas: Tensor | None,
    viewmat: Tensor,
    K: Tensor,
    background: Tensor | None,
    forward: Frame,
    v_image: Tensor,
    v_alphas: Tensor | None = None,
    *,
    eps2d: float = EPS2D,
    camera_model: str = "pinhole",
    deterministic: bool = True,
) -> RawGradients:
    """Gradients of the raw parameters for dL/dimage and dL/dalphas.

    Args:
        gaussians: means [N, 3], quats [N, 4], log_scales [N, 3], logit_opacities [N], sh [N, B, 3] with B = 1, 4, 9, 16 or 25, as
            `render_frame` had them, and likewise deltas [N, 16], viewmat [4, 4], K [3, 3], background [3], eps2d, camera_model.
        forward: what `render_frame(..., training=True)` gave.
        v_image: [H, W, 4], dL/d(red, green, blue, sum of w z). v_alphas: [H, W], zero where None.
        deterministic: the same bits every time. False: sums are taken as the tiles come, in 48 B of scratch memory per Gaussian
            and not per instance.

    Neither the camera nor the background gets a gradient. Raises InvalidInput for wrong
    shapes, types or devices.
    """
    height, width = _check(gaussians, deltas, viewmat, K, background, forward, v_image, v_alphas, camera_model)
    raw, sh = torch.ops.gsplat_core.render_frame_backward(
        *gaussians, deltas, viewmat, K, background, *_lists(forward), v_image, v_alphas, width, height, eps2d,
        CAMERA_MODELS.index(camera_model), deterministic,
    )  # fmt: skip
    return RawGradients(raw, sh)


def render_frame_backward_adam_(
    gaussians: Sequence[Tensor],
    first_moments: Sequence[Tensor],
    second_moments: Sequence[Tensor],
    rates: Tensor,
    step: Tensor,
    skipped: Tensor,
    deltas: Tensor | None,
    viewmat: Tensor,
    K: Tensor,
    background: Tensor | None,
    forward: Frame,
    v_image: Tensor,
    v_alphas: Tensor | None = None,
    *,
    eps2d: float = EPS2D,
    camera_model: str = "pinhole",
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
    needs_raw: bool = True,
    deterministic: bool = True,
) -> Tensor | None:
    """As `render_frame_backward`, and one step of Adam (Kingma and Ba 2015) over every Gaussian, in place.

    A Gaussian's row of a tensor stays as it is, moments and all, where its gradient (or the square of it) is not finite. Where
    the frame's lists were cut nothing changes.

    Args:
        gaussians, first_moments, second_moments: five tensors each, contiguous, of memory of their own.
        rates: float32 [5], the learning rates in the order of the tensors; step: int64 or int32 [1], counted from 1 (less
            is taken for 1). Both are read on the device, so that a captured graph sees new values.
        skipped: int64 [5]; the rows that were left alone are added to it.
        needs_raw: whether the raw gradients are wanted.

    Returns the raw gradients [N, 16] for a deformation field, with zeros for a Gaussian that has one that is not finite; None
    unless `needs_raw`.
    """
    height, width = _check(gaussians, deltas, viewmat, K, background, forward, v_image, v_alphas, camera_model)
    for kind, moments in (("first moment", first_moments), ("second moment", second_moments)):
        if len(moments) != RATES:
            raise InvalidInput(f"render_frame_backward_adam_ takes {RATES} tensors of {kind}s, got {len(moments)}")
        for parameter, moment in zip(gaussians, moments, strict=True):
            require_shape(f"a {kind}", moment, tuple(parameter.shape), "its parameter's shape")
    require_shape("rates", rates, (RATES,), "one per tensor")
    require_shape("skipped", skipped, (RATES,), "one per tensor")
    if step.numel() != 1 or step.dtype not in (torch.int32, torch.int64) or skipped.dtype != torch.int64:
        raise InvalidInput(
            f"step must be one int32 or int64 and skipped int64, got {step.dtype} {list(step.shape)} and {skipped.dtype}"
        )
    raw: Tensor = torch.ops.gsplat_core.render_frame_backward_adam_(
        *gaussians, deltas, viewmat, K, background, *_lists(forward), v_image, v_alphas, *first_moments, *second_moments,
        rates, step, skipped, width, height, eps2d, CAMERA_MODELS.index(camera_model), *betas, epsilon, needs_raw, deterministic,
    )  # fmt: skip
    return raw if needs_raw else None


def _lists(forward: Frame) -> tuple[Tensor, ...]:
    return (
        forward.records, forward.tile_offsets, forward.sorted, forward.splat_starts, forward.instance_splats,
        forward.status, forward.alphas, forward.last,
    )  # fmt: skip


def _check(
    gaussians: Sequence[Tensor],
    deltas: Tensor | None,
    viewmat: Tensor,
    K: Tensor,
    background: Tensor | None,
    forward: Frame,
    v_image: Tensor,
    v_alphas: Tensor | None,
    camera_model: str,
) -> tuple[int, int]:
    """Height and width of the picture; the raw ops check sizes against each other again."""
    if len(gaussians) != RATES:
        raise InvalidInput(f"gaussians must be means, quats, log_scales, logit_opacities and sh, got {len(gaussians)}")
    means, quats, log_scales, logit_opacities, sh = gaussians
    require_float32(
        "render_frame_backward", means=means, quats=quats, log_scales=log_scales, logit_opacities=logit_opacities, sh=sh,
        deltas=deltas, viewmat=viewmat, K=K, background=background, v_image=v_image, v_alphas=v_alphas,
    )  # fmt: skip
    if means.device.type != "cuda":
        raise InvalidInput(
            f"render_frame_backward runs on CUDA only, and means is on {means.device}; elsewhere take autograd through"
            " gsplat_core.render or gsplat_core.reference.frame.render_frame"
        )
    n = means.shape[0] if means.dim() else 0
    bases = sh.shape[1] if sh.dim() == 3 else 0
    for name, tensor, shape in (
        ("means", means, (n, 3)), ("quats", quats, (n, 4)), ("log_scales", log_scales, (n, 3)),
        ("logit_opacities", logit_opacities, (n,)), ("sh", sh, (n, bases, 3)), ("deltas", deltas, (n, RAW_COLUMNS)),
        ("viewmat", viewmat, (4, 4)), ("K", K, (3, 3)), ("background", background, (3,)),
    ):  # fmt: skip
        if tensor is not None:
            require_shape(name, tensor, shape, "for N Gaussians")
    if bases not in (1, 4, 9, 16, 25):
        raise InvalidInput(f"sh must be [N, B, 3] with B = 1, 4, 9, 16 or 25, got {list(sh.shape)}")
    if camera_model not in CAMERA_MODELS:
        raise InvalidInput(f"camera_model must be one of {CAMERA_MODELS}, got {camera_model!r}")
    height, width = forward.alphas.shape
    require_shape("v_image", v_image, (height, width, 4), "[H, W, 4]")
    if v_alphas is not None:
        require_shape("v_alphas", v_alphas, (height, width), "[H, W]")
    return height, width


@torch.library.register_fake("gsplat_core::render_frame_backward")
def _backward_fake(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    *rest: Tensor | float | None,
) -> tuple[Tensor, Tensor]:
    return means.new_empty(means.shape[0], RAW_COLUMNS), torch.empty_like(sh) if sh.shape[1] > 1 else sh.new_empty(0)


@torch.library.register_fake("gsplat_core::render_frame_backward_adam_")
def _backward_adam_fake(means: Tensor, *rest: Tensor | float | None) -> Tensor:
    return means.new_empty(means.shape[0], RAW_COLUMNS) if rest[-2] else means.new_empty(0)
