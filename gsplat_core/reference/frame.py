"""One frame from raw Gaussians and deltas in plain torch: test reference of the CUDA op `render_frame`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_same_kind, require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.frame.view import View
from gsplat_core.reference.rendering import rasterization
from gsplat_core.rendering.settings import RenderMode
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION


def render_frame(
    gaussians: Sequence[Tensor], deltas: Tensor | None, view: View, *, expected_depth: bool = False
) -> tuple[Tensor, Tensor]:
    """Deform, activate and render N Gaussians for one camera (Kerbl et al. 2023); differentiable.

    Accepts any floating dtype. A Gaussian with a non-finite parameter or delta is culled and gets zero gradients.

    Args:
        gaussians: raw parameters: means [N, 3], quats [N, 4] (wxyz, non-zero), log_scales [N, 3], logit_opacities [N],
            sh [N, B, 3] with B a square.
        deltas: [N, 16], added to the raw parameters in the layout of `scene.gaussians`, or None.
        view: camera; its tensors have the Gaussians' dtype.
        expected_depth: normalise the fourth channel to the weighted mean of z; otherwise it is the weighted sum.

    Returns:
        Image [H, W, 4] (red, green, blue, depth) and alphas [H, W].

    Raises:
        InvalidInput: for wrong shapes.
    """
    means, quats, log_scales, logit_opacities, sh = gaussians
    n, bases = len(means), sh.shape[1] if sh.dim() == 3 else 0
    require_shape("quats", quats, (n, 4), "[N, 4]")
    require_shape("log_scales", log_scales, (n, 3), "[N, 3]")
    require_shape("logit_opacities", logit_opacities, (n,), "[N]")
    degree = math.isqrt(bases) - 1
    if bases < 1 or (degree + 1) ** 2 != bases or tuple(sh.shape) != (n, bases, 3):
        raise InvalidInput(f"sh must be [N, B, 3] with N = {n} and B a square, got {list(sh.shape)}")
    raw = torch.cat([means, quats, log_scales, sh[:, 0], logit_opacities[:, None]], 1)
    if deltas is not None:
        require_shape("deltas", deltas, (n, RAW_COLUMNS), "[N, 16]")
        require_same_kind(means=means, deltas=deltas)
        raw = raw + deltas[:, : raw.shape[1]]
    # Select before any arithmetic, because a masked NaN would still reach the gradient.
    usable = (raw.isfinite().all(1) & sh.isfinite().flatten(1).all(1)).nonzero()[:, 0]
    mean, quat, log_scale, dc, logit = (
        raw[usable][:, group] for group in (POSITION, ROTATION, LOG_SCALE, COLOUR, OPACITY)
    )
    mode: RenderMode = "RGB+ED" if expected_depth else "RGB+D"
    background = None if view.background is None else view.background[None]
    image, alphas, _ = rasterization(
        mean, quat, log_scale.exp(), torch.sigmoid(logit[:, 0]), torch.cat([dc[:, None], sh[usable, 1:]], 1),
        view.viewmat[None], view.K[None], view.width, view.height, near_plane=view.near_plane, far_plane=view.far_plane,
        eps2d=view.eps2d, sh_degree=degree, packed=False, backgrounds=background, render_mode=mode,
        camera_model=view.camera_model,
    )  # fmt: skip
    return image[0], alphas[0, ..., 0]
