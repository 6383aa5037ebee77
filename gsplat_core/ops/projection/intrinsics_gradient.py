"""Gradient of the projection with respect to the intrinsics, in torch operations of any device.

Focal lengths scale the rows of the projection's Jacobian J, and the principal point shifts the image. Where the pinhole
Jacobian is clamped, its last column depends on the principal point instead of the focal length.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.ops.arguments import FOV_MARGIN
from gsplat_core.ops.covariance import quat_scale_to_covar_preci

NEAR_AXIS = 0.0625
"""Squared tangent of the angle to the axis below which the fisheye's quotients use their Taylor series."""


def intrinsics_gradient(
    means: Tensor,
    covariances: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    radii: Tensor,
    conics: Tensor,
    compensations: Tensor | None,
    gradients: tuple[Tensor | None, Tensor | None, Tensor | None],
    size: tuple[int, int],
    camera_model: str,
    compensation_floor: float,
) -> Tensor:
    """Return the gradient [..., C, 3, 3] with respect to Ks.

    Args:
        means: [..., N, 3].
        covariances: world-space covariances [..., N, 3, 3].
        viewmats, Ks: [..., C, 4, 4] and [..., C, 3, 3].
        radii, conics, compensations: results of the projection; radii are 0 where culled.
        gradients: gradients of means2d [..., C, N, 2], conics [..., C, N, 3] and compensations [..., C, N], or None.
        size: width and height in pixels.
        camera_model: "pinhole", "ortho" or "fisheye".
        compensation_floor: lower limit of the compensations, without gradient where active.
    """
    visible = radii[..., 0] > 0
    rotation = viewmats[..., :3, :3]
    local = torch.einsum("...cij,...nj->...cni", rotation, torch.nan_to_num(means, 0.0, 0.0, 0.0))
    local = local + viewmats[..., None, :3, 3]
    depth = torch.where(visible, local[..., 2], torch.ones_like(local[..., 2]))
    local = torch.cat([torch.where(visible[..., None], local[..., :2], 0), depth[..., None]], -1)
    focal, center = Ks.diagonal(dim1=-2, dim2=-1)[..., None, :2], Ks[..., None, :2, 2]
    jacobian, plain, clamped = _jacobian(local, focal, center, size, camera_model)
    v_focal, v_center = torch.zeros_like(plain), torch.zeros_like(plain)
    v_means2d, v_conics, v_compensations = gradients
    if v_means2d is not None:
        v_means2d = torch.where(visible[..., None], v_means2d, 0)
        v_focal, v_center = v_focal + v_means2d * plain, v_center + v_means2d
    if v_conics is not None or v_compensations is not None:
        conic = torch.where(visible[..., None, None], _matrices(conics), 0)
        v_covars = torch.zeros_like(conic)
        if v_conics is not None:
            v_conic = torch.where(visible[..., None, None], _matrices(v_conics), 0)
            half = torch.eye(2, dtype=conic.dtype, device=conic.device) * 0.5 + 0.5
            v_covars = v_covars - conic @ (v_conic * half) @ conic
        turned = torch.where(visible[..., None, None], jacobian @ rotation[..., None, :, :], 0)
        world = torch.where(visible.any(-2)[..., None, None], covariances, 0)
        spread = turned @ world[..., None, :, :, :]
        if v_compensations is not None and compensations is not None:
            # compensation² = det c / det (c + blur), with the adjugate of c
            covars = spread @ turned.transpose(-1, -2)
            a, b, c = covars[..., 0, 0], covars[..., 0, 1], covars[..., 1, 1]
            adjugate = torch.stack([c, -b, -b, a], -1).unflatten(-1, (2, 2))
            det = conic[..., 0, 0] * conic[..., 1, 1] - conic[..., 0, 1] ** 2
            above = visible & (compensations > compensation_floor)
            factor = torch.where(above, compensations, 1)[..., None, None]
            change = 0.5 * (adjugate * det[..., None, None] / factor - factor * conic)
            v_covars = v_covars + torch.where(above, v_compensations, 0)[..., None, None] * change
        v_jacobian = 2 * v_covars @ (spread @ rotation[..., None, :, :].transpose(-1, -2))
        rows = v_jacobian * jacobian
        last = torch.where(clamped, 0, rows[..., 2])
        v_focal = v_focal + (rows[..., 0] + rows[..., 1] + last) / focal
        v_center = v_center + torch.where(clamped, v_jacobian[..., 2] / local[..., 2:], 0)
    v_Ks = torch.zeros_like(Ks)
    # In float32, the sum would depend on the number of threads.
    v_focal, v_center = (values.sum(-2, dtype=torch.float64).to(Ks.dtype) for values in (v_focal, v_center))
    v_Ks[..., 0, 0], v_Ks[..., 1, 1] = v_focal.unbind(-1)
    v_Ks[..., 0, 2], v_Ks[..., 1, 2] = v_center.unbind(-1)
    return v_Ks


def intrinsics_gradient_of_rows(
    gaussians: Tensor,
    images: Tensor,
    inputs: tuple[Tensor, Tensor | None, Tensor | None, Tensor | None, Tensor, Tensor],
    conics: Tensor,
    compensations: Tensor | None,
    gradients: tuple[Tensor | None, Tensor | None, Tensor | None],
    size: tuple[int, int],
    camera_model: str,
    compensation_floor: float,
) -> Tensor:
    """Return the gradient with respect to Ks, shape as Ks, from visible pairs of image and Gaussian. The host waits.

    Args:
        gaussians: index [rows] into the Gaussians of all batches.
        images: index [rows] into the cameras of all batches, ascending.
        inputs: means, covars, quats, scales, viewmats and Ks of the projection.
        conics, compensations, gradients: values [rows, ...] of the rows; others as in `intrinsics_gradient`.
    """
    means, covars, quats, scales, viewmats, Ks = inputs
    v_means2d, v_conics, v_compensations = gradients
    of_rows = lambda values: None if values is None else values.reshape(-1, values.shape[-1])[gaussians]
    single = lambda values: None if values is None else values[:, None, None]
    flat_Ks, seen = Ks.reshape(-1, 3, 3), conics.new_ones(len(conics), 1, 1, 1)
    each = intrinsics_gradient(
        means.reshape(-1, 3)[gaussians][:, None],
        world_covariances(of_rows(covars), of_rows(quats), of_rows(scales))[:, None],
        viewmats.reshape(-1, 1, 4, 4)[images], flat_Ks[images][:, None], seen, conics[:, None, None], single(compensations),
        (single(v_means2d), single(v_conics), single(v_compensations)), size, camera_model, compensation_floor,
    )  # fmt: skip
    counts = torch.bincount(images, minlength=len(flat_Ks)).tolist()
    parts = [part.sum(0, dtype=torch.float64) for part in each[:, 0].split(counts)]
    return (torch.stack(parts) if parts else flat_Ks).to(Ks.dtype).reshape(Ks.shape)


def world_covariances(covars: Tensor | None, quats: Tensor | None, scales: Tensor | None) -> Tensor:
    """Return covariances [..., N, 3, 3] from upper triangles, or from rotations and scales; without gradient."""
    if covars is not None:
        a, b, c, d, e, f = covars.unbind(-1)
        return torch.stack([a, b, c, b, d, e, c, e, f], -1).unflatten(-1, (3, 3))
    assert quats is not None and scales is not None
    covariances, _ = quat_scale_to_covar_preci(quats.detach(), scales.detach(), compute_preci=False)
    assert covariances is not None
    return covariances


def _matrices(triangles: Tensor) -> Tensor:
    """Return symmetric matrices [..., 2, 2] of upper triangles [..., 3]."""
    a, b, c = triangles.unbind(-1)
    return torch.stack([a, b, b, c], -1).unflatten(-1, (2, 2))


def _jacobian(
    local: Tensor, focal: Tensor, center: Tensor, size: tuple[int, int], camera_model: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Return Jacobians [..., C, N, 2, 3], image points at unit focal length [..., C, N, 2], and masks of clamped rows."""
    x, y, z = local.unbind(-1)
    fx, fy = focal.unbind(-1)
    zero, never = torch.zeros_like(x), torch.zeros_like(local[..., :2], dtype=torch.bool)
    if camera_model == "ortho":
        rows = [fx.expand_as(x), zero, zero, zero, fy.expand_as(x), zero]
        return torch.stack(rows, -1).unflatten(-1, (2, 3)), local[..., :2], never
    if camera_model == "pinhole":
        plain = local[..., :2] / z[..., None]
        half = 0.5 * torch.stack([torch.full_like(fx, size[0]), torch.full_like(fx, size[1])], -1)
        margin = FOV_MARGIN * half / focal
        lowest, highest = -(center / focal + margin), (2 * half - center) / focal + margin
        slope = torch.minimum(torch.maximum(plain, lowest), highest)
        rows = [fx / z, zero, -fx * slope[..., 0] / z, zero, fy / z, -fy * slope[..., 1] / z]
        return torch.stack(rows, -1).unflatten(-1, (2, 3)), plain, slope != plain
    r2 = x * x + y * y
    t = r2 / (z * z)
    near = (t < NEAR_AXIS) & (z > 0)
    safe = torch.where(near, torch.ones_like(r2), r2)
    s = torch.atan2(safe.sqrt(), z) / safe.sqrt()
    q = (z / (safe + z * z) - s) / safe
    t = torch.where(near, t, zero)
    s_near = sum(((-t) ** k / (2 * k + 1) for k in range(8)), zero) / z
    q_near = sum((-((-t) ** k) * (2 * k + 2) / (2 * k + 3) for k in range(8)), zero) / z**3
    s, q = torch.where(near, s_near, s), torch.where(near, q_near, q)
    w = 1 / (r2 + z * z)
    rows = [fx * (s + q * x * x), fx * q * x * y, -fx * x * w, fy * q * x * y, fy * (s + q * y * y), -fy * y * w]
    return torch.stack(rows, -1).unflatten(-1, (2, 3)), local[..., :2] * s[..., None], never
