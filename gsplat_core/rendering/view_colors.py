"""The colours that cameras see, and the Gaussians that are culled for theirs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsplat_core.ops.projection.arguments import DenseProjection
from gsplat_core.rendering.settings import RenderSettings

if TYPE_CHECKING:
    from gsplat_core.rendering.chain import StepOperations


def view_colors(
    ops: StepOperations,
    means: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    dense: DenseProjection,
    settings: RenderSettings,
) -> tuple[Tensor, DenseProjection]:
    """Colours [..., C, N, D] seen by each camera; Gaussians whose colour is not finite are culled.

    On CUDA nothing here makes the host wait. The colours of those that are culled for them stay as they are: they are in no
    list, compositing skips what is not finite, and a colour without a gradient passes none on.
    """
    shape = dense.depths.shape
    visible = dense.radii[..., 0] > 0

    def evaluate(visible: Tensor) -> Tensor:
        per_camera = colors.dim() - (1 if settings.sh_degree is None else 2) == len(shape)
        if settings.sh_degree is None:
            values = colors if per_camera else colors[..., None, :, :]
            return values.expand(*shape, values.shape[-1])
        directions = means[..., None, :, :] - camera_centers(viewmats)[..., None, :]
        # The extra dimension is broadcast by the op, which saves one copy of the coefficients per camera.
        coefficients = colors if per_camera or means.dim() == 2 else colors[..., None, :, :, :]
        return ops.spherical_harmonics(settings.sh_degree, directions, coefficients, masks=visible)

    def shown(values: Tensor) -> Tensor:
        return values if settings.sh_degree is None else (values + 0.5).clamp_min(0)

    values = evaluate(visible)  # looked at before they are clamped: minus infinity would be black
    if values.is_cuda and ops.zero_gradients_stay_zero:
        finite = (values.detach() * 0).sum(-1) == 0  # 0 times a number is 0, unless it is a NaN or an infinity
        return shown(values), dense._replace(radii=dense.radii * finite.to(dense.radii.dtype)[..., None])
    # One cheap sum in the common case; it can only miss nothing, as a sum with a NaN or an infinity is not finite. A compiled
    # graph cannot branch on it, and always takes the long way.
    if torch.compiler.is_compiling() or not torch.isfinite(values.detach().sum()):
        finite = values.detach().isfinite().all(-1)
        visible = visible & finite
        values = torch.where(visible[..., None], evaluate(visible), torch.zeros_like(values))
        keep = visible.to(dense.radii.dtype)
        dense = dense._replace(radii=dense.radii * keep[..., None])
    return shown(values), dense


def camera_centers(viewmats: Tensor) -> Tensor:
    """The first three numbers of the last column of the inverse of [..., 4, 4] matrices, any that have one: [..., 3].

    On CUDA by Cramer's rule, for `torch.linalg.inv` makes the host wait there to see whether there is an inverse: the vector
    that the first three rows are orthogonal to, scaled so that its product with the fourth is 1.
    """
    if not viewmats.is_cuda:
        return torch.linalg.inv(viewmats)[..., :3, 3]
    rows, shifts = viewmats[..., :3, :3], viewmats[..., :3, 3]
    crosses = torch.linalg.cross(rows.roll(-1, -2), rows.roll(-2, -2))
    center = -(shifts[..., None] * crosses).sum(-2)
    determinant = (rows[..., 0, :] * crosses[..., 0, :]).sum(-1, keepdim=True)
    last = viewmats[..., 3, :]
    return center / ((last[..., :3] * center).sum(-1, keepdim=True) + last[..., 3:] * determinant)
