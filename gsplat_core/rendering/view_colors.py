"""View-dependent colours, with culling of Gaussians with non-finite colours."""

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
    """Return the colours [..., C, N, D] seen by each camera; cull Gaussians with non-finite colour.

    On CUDA the host does not synchronise, so colours of culled Gaussians are not replaced. They
    have no
    effect: culled Gaussians are in no tile list, compositing skips non-finite values, and a zero
    colour gradient adds nothing to the coefficients' gradient.
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

    # checked before clamping, which would turn minus infinity into black
    values = evaluate(visible)
    if values.is_cuda and ops.zero_gradients_stay_zero:
        finite = (values.detach() * 0).sum(-1) == 0  # 0 times a number is 0, unless it is a NaN or an infinity
        return shown(values), dense._replace(radii=dense.radii * finite.to(dense.radii.dtype)[..., None])
    # One cheap sum in the common case: a sum with a NaN or an infinity in it is not finite. A compiled graph cannot branch on a
    # value, and always tests every colour.
    if torch.compiler.is_compiling() or not torch.isfinite(values.detach().sum()):
        finite = values.detach().isfinite().all(-1)
        visible = visible & finite
        values = torch.where(visible[..., None], evaluate(visible), torch.zeros_like(values))
        keep = visible.to(dense.radii.dtype)
        dense = dense._replace(radii=dense.radii * keep[..., None])
    return shown(values), dense


def camera_centers(viewmats: Tensor) -> Tensor:
    """Return the camera centres [..., 3] of world-to-camera matrices [..., 4, 4].

    This is the translation column of the inverse of any invertible matrix. On CUDA it is computed
    by Cramer's rule, because `torch.linalg.inv` synchronises with the host to check invertibility.
    The centre is the vector orthogonal to the first three rows, scaled so that its product with the
    fourth row is 1.
    """
    if not viewmats.is_cuda:
        return torch.linalg.inv(viewmats)[..., :3, 3]
    rows, shifts = viewmats[..., :3, :3], viewmats[..., :3, 3]
    crosses = torch.linalg.cross(rows.roll(-1, -2), rows.roll(-2, -2))
    center = -(shifts[..., None] * crosses).sum(-2)
    determinant = (rows[..., 0, :] * crosses[..., 0, :]).sum(-1, keepdim=True)
    last = viewmats[..., 3, :]
    return center / ((last[..., :3] * center).sum(-1, keepdim=True) + last[..., 3:] * determinant)
