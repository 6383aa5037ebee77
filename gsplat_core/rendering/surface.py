"""Surface seen by a camera: depth along each ray, normal and confidence.

Each splat is a planar surface element with a normal and a depth along each ray. The density of a Gaussian along a ray
is highest at the conditional mean of z, not at its centre's z. To first order this is affine in the pixel (Zhang et al.
2024, "RaDe-GS", section 3): z(u) = z_centre + slope · (u - u_centre).

The elements are blended in plain torch, tile by tile, with the blending weights of the picture. This is about a hundred
times slower than the compiled blending, which keeps only sums. A median needs the sorted order of the splats.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.ops.compositing.compositing import rasterize_to_pixels
from gsplat_core.ops.covariance.covariance import quat_scale_to_covar_preci
from gsplat_core.ops.projection.arguments import ALPHA_CUTOFF, DenseProjection
from gsplat_core.ops.projection.projection import fully_fused_projection
from gsplat_core.ops.tiles.grid import TileGrid
from gsplat_core.ops.tiles.tiles import bin_splats
from gsplat_core.rendering.settings import CONSTANTS, TILE_SIZE
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
    """Projections of the splats to one camera, [N, ...]."""
    opacities: Tensor
    """Opacities of the splats, [N]."""
    slopes: Tensor
    """Change of z along a splat per pixel to the right and down, [N, 2]."""
    variances: Tensor
    """Variance [N] of z along the ray, due to the thickness of the Gaussian."""
    normals: Tensor
    """Unit normals [N, 3] in camera axes, towards the camera: the Gaussian's shortest axis."""

    def depths_at_origin(self) -> Tensor:
        """z [N] of each splat's plane at pixel coordinates (0, 0), so that z(u) = this + slopes · u."""
        return self.rows.depths - (self.slopes * self.rows.means2d).sum(-1)


class TileLists(NamedTuple):
    """Splats of every tile in depth order."""

    ids: Tensor
    """Splat indices of all lists, one list after another, int32 [M]."""
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
    """Return the derivative [N, 2, 3] of pixel by camera-space coordinates at the splats' centres."""
    fx, fy = intrinsics[0, 0].expand(len(local)), intrinsics[1, 1].expand(len(local))
    x, y, z = local.unbind(-1)
    zero = torch.zeros_like(x)
    if camera.model == "ortho":
        return torch.stack([fx, zero, zero, zero, fy, zero], -1).unflatten(-1, (2, 3))
    if camera.model == "pinhole":
        return torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).unflatten(-1, (2, 3))
    # For a fisheye camera return a zero derivative, so that a splat has its centre's depth. Near the edge of the
    # picture z does not measure distance.
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


TRANSMITTANCE_STOP = 1e-4
"""Minimum transmittance; blending ends before the splat that would go below it."""


class AlongRays(NamedTuple):
    """Depth statistics of each pixel's ray [H, W]; 0 where no splat is hit."""

    median: Tensor
    """z of the splat at which transmittance falls below 1/2; 0 if it never does."""
    spread: Tensor
    """Standard deviation of z along the ray, across splats and within their thickness."""


class TileOfRays(NamedTuple):
    """P rays of one tile, and the L splats of its list in order."""

    rows: slice
    columns: slice
    splats: Tensor
    """Indices of the splats in the tile's list, [L]."""
    weights: Tensor
    """Blending weight of each splat in each pixel, [P, L]."""
    through: Tensor
    """Transmittance [P, L] behind each splat."""
    depths: Tensor
    """z of each splat at its intersection with the ray, [P, L]."""


def along_rays(planes: SplatPlanes, lists: TileLists, camera: Camera) -> AlongRays:
    """Compute median depth and spread of every pixel."""
    made = planes.opacities.new_zeros(2, camera.height_px, camera.width_px)
    for tile in tiles_of_rays(planes, lists, camera):
        shape = (tile.rows.stop - tile.rows.start, tile.columns.stop - tile.columns.start)
        behind_half = (tile.through > 0.5).sum(1)
        inside = behind_half < tile.through.shape[1]
        at = behind_half.clamp(max=tile.through.shape[1] - 1)[:, None]
        median = torch.where(inside, tile.depths.gather(1, at)[:, 0], 0)
        total = tile.weights.sum(1).clamp(min=1e-10)
        mean = (tile.weights * tile.depths).sum(1) / total
        off = tile.depths - mean[:, None]
        variance = (tile.weights * (off * off + planes.variances[tile.splats])).sum(1) / total
        made[0, tile.rows, tile.columns] = median.reshape(shape)
        made[1, tile.rows, tile.columns] = variance.sqrt().reshape(shape)
    return AlongRays(made[0], made[1])


def tiles_of_rays(planes: SplatPlanes, lists: TileLists, camera: Camera) -> Iterator[TileOfRays]:
    """Yield the non-empty tiles, with the same limits and order of blending as the picture."""
    columns = torch.cat([planes.rows.means2d, planes.rows.conics, planes.opacities[:, None], planes.slopes], 1)
    columns = torch.cat([columns, planes.depths_at_origin()[:, None]], 1)
    starts = [*lists.starts.flatten().tolist(), len(lists.ids)]
    tiles_across = lists.starts.shape[1]
    for number in range(len(starts) - 1):
        ids = lists.ids[starts[number] : starts[number + 1]].long()
        if not len(ids):
            continue
        top, left = number // tiles_across * TILE_SIZE, number % tiles_across * TILE_SIZE
        rows = slice(top, min(top + TILE_SIZE, camera.height_px))
        across = slice(left, min(left + TILE_SIZE, camera.width_px))
        y = torch.arange(rows.start, rows.stop, device=ids.device) + 0.5
        x = torch.arange(across.start, across.stop, device=ids.device) + 0.5
        y, x = (grid.reshape(-1, 1).to(columns.dtype) for grid in torch.meshgrid(y, x, indexing="ij"))
        weights, through, depths = _blended_tile(columns[ids], x, y)
        yield TileOfRays(rows, across, ids, weights, through, depths)


def _blended_tile(splats: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    mean_x, mean_y, xx, xy, yy, opacity, slope_x, slope_y, depth = splats.unbind(1)
    dx, dy = mean_x - x, mean_y - y
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = (opacity * torch.exp(-sigma)).clamp(max=CONSTANTS["1.6"].max_alpha)
    alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_CUTOFF), alpha, 0)
    through = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)
    blended = through > TRANSMITTANCE_STOP
    return torch.where(blended, alpha * before, 0), through, depth + slope_x * x + slope_y * y


COVERED = 0.1
"""Minimum opacity of an observed pixel."""
HALVED_AFTER_S = 5.0
"""Time in seconds after which the confidence in unseen tissue is 1/2; it is 1/3 after twice that."""


class Surface(NamedTuple):
    """Surface seen by one camera, in the scene's unit and camera axes (x right, y down, z forward)."""

    alpha: Tensor
    """Accumulated opacity [H, W], 0 to 1."""
    ray_depth: Tensor
    """Expected z [H, W] at the rays' intersections with the splats; 0 where unobserved."""
    normals: Tensor
    """Unit normals [H, W, 3] towards the camera: blended shortest axes; 0 where unobserved."""
    median_depth: Tensor
    """z [H, W] of the splat at which transmittance falls below 1/2; 0 if it never does."""
    spread: Tensor
    """Standard deviation of z along the ray [H, W]. Does not include a systematic error."""
    confidence: Tensor
    """Confidence [H, W], 0 to 1: opacity, reduced where tissue has not been seen (`certainty`)."""

    @property
    def observed(self) -> Tensor:
        """Mask [H, W] of pixels with an observed surface."""
        return self.alpha >= COVERED


def certainty(unseen_s: Tensor) -> Tensor:
    """Return the confidence [N] in Gaussians, 0 to 1, by the time [N] in seconds since last seen."""
    return 1 / (1 + unseen_s / HALVED_AFTER_S)


SURFACE_OUTPUTS = tuple(name for name in Surface._fields if name != "alpha")
"""Outputs that a renderer offers in addition to picture, opacity and centre depth."""


@torch.no_grad()
def render_surface(gaussians: Gaussians, camera: Camera, certain: Tensor | None = None) -> Surface:
    """Render the surface seen by `camera`, float32 on the Gaussians' device.

    Much slower than a picture (see the module docstring).

    Args:
        gaussians: Gaussians at one time.
        camera: camera of the outputs.
        certain: confidence [N], 0 to 1, of each Gaussian; None for 1.
    """
    if certain is not None:
        require_shape("certain", certain, (gaussians.count,), "[N]")
    planes = splat_planes(gaussians, camera)
    lists = tile_lists(planes, camera)
    blended, alpha = _blended(planes, lists, camera, certain)
    observed = alpha >= COVERED
    offset, slope_x, slope_y = (blended[..., k] / alpha.clamp(min=1e-10) for k in range(3))
    x = torch.arange(camera.width_px, device=alpha.device) + 0.5
    y = torch.arange(camera.height_px, device=alpha.device)[:, None] + 0.5
    depth = torch.where(observed, offset + slope_x * x + slope_y * y, 0)
    normals = torch.nn.functional.normalize(blended[..., 3:6], dim=-1)
    normals = torch.where(observed[..., None], normals, 0)
    rays = along_rays(planes, lists, camera)
    median, spread = (torch.where(observed, plane, 0) for plane in rays)
    return Surface(alpha, depth, normals, median, spread, alpha if certain is None else blended[..., 6])


def _blended(planes: SplatPlanes, lists: TileLists, camera: Camera, certain: Tensor | None) -> tuple[Tensor, Tensor]:
    """Blend per-splat values [H, W, 6 or 7] (depth plane, normal, certainty) and the opacity [H, W]."""
    columns = [planes.depths_at_origin()[:, None], planes.slopes, planes.normals]
    if certain is not None:
        columns.append(certain.to(planes.opacities.dtype)[:, None])
    channels = torch.cat(columns, 1)
    rows = planes.rows
    image, alpha = rasterize_to_pixels(
        rows.means2d[None], rows.conics[None], channels[None], planes.opacities[None], camera.width_px,
        camera.height_px, TILE_SIZE, lists.starts[None], lists.ids,
    )  # fmt: skip
    return image[0], alpha[0, ..., 0]
