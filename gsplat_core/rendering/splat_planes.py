"""Splats as planar surface elements with a normal and a depth along each ray.

The density of a Gaussian along a ray is highest at the conditional mean of z, not at its centre's
z. To first order this is affine in the pixel (Zhang et al. 2024, "RaDe-GS", section 3): z(u) =
z_centre + slope · (u - u_centre).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.covariance.covariance import quat_scale_to_covar_preci
from gsplat_core.ops.projection.arguments import DenseProjection
from gsplat_core.ops.projection.projection import fully_fused_projection
from gsplat_core.ops.tiles.grid import TileGrid
from gsplat_core.ops.tiles.tiles import bin_splats
from gsplat_core.rendering.settings import TILE_SIZE
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

LEAST_VARIANCE = 0.01
"""Variance in pixels² added to a splat's extent before its depth is extrapolated.

A needle pointing at the camera has no defined plane. The picture's blur (`EPS2D`) is not used here,
because it biases the depth of tilted surfaces.
"""


class SplatPlanes(NamedTuple):
    """Splats projected to one camera; values of culled splats are finite and meaningless."""

    rows: DenseProjection
    """[N, ...]."""
    opacities: Tensor
    """[N]."""
    slopes: Tensor
    """Change of z along a splat per pixel to the right and down, [N, 2]."""
    variances: Tensor
    """Variance [N] of z along the ray, due to the thickness of the Gaussian."""
    normals: Tensor
    """Unit normals [N, 3] in camera axes, towards the camera: the Gaussian's shortest axis."""

    def depths_at_origin(self) -> Tensor:
        """z [N] of each splat's plane at pixel coordinates (0, 0), so that z(u) = this + slopes ·
        u.
        """
        return self.rows.depths - (self.slopes * self.rows.means2d).sum(-1)


class TileLists(NamedTuple):
    """Splats of every tile in depth order."""

    ids: Tensor
    """int32 [M]."""
    starts: Tensor
    """Start of each tile's list, int32 [tile_height, tile_width]."""


def splat_planes(gaussians: Gaussians, camera: Camera) -> SplatPlanes:
    """Convert Gaussians to surface elements seen by `camera`."""
    viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
    scales, opacities = gaussians.scales, gaussians.opacities
    projected = fully_fused_projection(
        gaussians.means, None, gaussians.quats, scales, viewmat[None], intrinsics[None], camera.width_px,
        camera.height_px, camera_model=camera.model, opacities=opacities,
    )  # fmt: skip
    assert isinstance(projected, DenseProjection)
    rows = DenseProjection(*(None if column is None else column[0] for column in projected))  # type: ignore[arg-type]
    visible = (rows.radii > 0).all(-1)
    rotation = viewmat[:3, :3]
    local = gaussians.means @ rotation.T + viewmat[:3, 3]
    local = torch.where(visible[:, None], local, local.new_tensor([0, 0, 1]))
    quats = torch.where(visible[:, None], gaussians.quats, gaussians.quats.new_tensor([1, 0, 0, 0]))
    scales = torch.where(visible[:, None], scales, 1)
    covariance, _ = quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    assert covariance is not None
    covariance = rotation @ covariance @ rotation.T
    slopes, variances = _conditional(covariance, _jacobian(local, intrinsics, camera))
    return SplatPlanes(rows, opacities, slopes, variances, _facing(quats, scales, rotation, local, camera))


def _conditional(covariance: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """Return slopes [N, 2] and variance [N] of z conditional on the pixel.

    The inputs are covariances [N, 3, 3] in camera axes and projection Jacobians.
    """
    pixels = jacobian @ covariance @ jacobian.transpose(1, 2)
    with_z = (jacobian @ covariance[:, :, 2:])[..., 0]
    xx, xy, yy = pixels[:, 0, 0] + LEAST_VARIANCE, pixels[:, 0, 1], pixels[:, 1, 1] + LEAST_VARIANCE
    determinant = (xx * yy - xy * xy).clamp(min=LEAST_VARIANCE**2)
    across, down = with_z.unbind(-1)
    slopes = torch.stack([yy * across - xy * down, xx * down - xy * across], -1) / determinant[:, None]
    return slopes, (covariance[:, 2, 2] - (slopes * with_z).sum(-1)).clamp(min=0)


def _jacobian(local: Tensor, intrinsics: Tensor, camera: Camera) -> Tensor:
    """Return the derivative [N, 2, 3] of pixel by camera-space coordinates at the
    splats' centres.
    """
    fx, fy = intrinsics[0, 0].expand(len(local)), intrinsics[1, 1].expand(len(local))
    x, y, z = local.unbind(-1)
    zero = torch.zeros_like(x)
    if camera.model == "ortho":
        return torch.stack([fx, zero, zero, zero, fy, zero], -1).unflatten(-1, (2, 3))
    if camera.model == "pinhole":
        return torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).unflatten(-1, (2, 3))
    # Near the edge of a fisheye picture z does not measure distance. Use the depth of the centre
    # there.
    return local.new_zeros(len(local), 2, 3)


def _facing(quats: Tensor, scales: Tensor, rotation: Tensor, local: Tensor, camera: Camera) -> Tensor:
    """Return the shortest principal axes in camera axes [N, 3], towards the camera."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    axes = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1),
            torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1),
            torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )  # the rows are the columns of the rotation
    shortest = scales.argmin(-1)[:, None, None].expand(-1, 1, 3)
    normals = axes.gather(1, shortest)[:, 0] @ rotation.T
    towards = normals[:, 2:] if camera.model == "ortho" else (normals * local).sum(-1, keepdim=True)
    return torch.where(towards > 0, -normals, normals)


def tile_lists(planes: SplatPlanes, camera: Camera) -> TileLists:
    """Return the splats that touch each tile, sorted by depth of their centres."""
    grid = TileGrid(TILE_SIZE, -(-camera.width_px // TILE_SIZE), -(-camera.height_px // TILE_SIZE))
    rows = planes.rows
    _, ids, starts = bin_splats(
        rows.means2d[None], rows.radii[None], rows.depths[None], grid, conics=rows.conics[None],
        opacities=planes.opacities[None],
    )  # fmt: skip
    return TileLists(ids, starts.reshape(-(-camera.height_px // TILE_SIZE), -(-camera.width_px // TILE_SIZE)))
