"""Surface seen by a camera: depth along each ray, normals, spread, classes and confidence, with gradients. Also removal of
Gaussians that contribute to no picture.

The density of a Gaussian along a ray is highest at the midpoint of the chord in its ellipsoid, not at its centre's z
(UniGS, Xie et al. 2025). `render_rays` blends these depths and further values of the splats with the weights of the
picture.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.arguments import DenseProjection, TileGrid, View, require_shape
from gsplat_core.ops.projection import fully_fused_projection
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.depth_maps import depth_normals
from gsplat_core.rendering.settings import TILE_SIZE
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsplat_core.ops.ray_blending import BlendedRays

COVERED = 0.1
"""Minimum accumulated opacity at which a pixel counts as observed."""
HALVED_AFTER_S = 5.0
"""Time in seconds after which the confidence in unseen tissue is 1/2; it is 1/3 after twice that."""
SEMANTICS = "semantics"
"""Name in `Gaussians.extra` of the logits [N, K] of K classes."""


class Surface(NamedTuple):
    """Surface seen by one camera, in the scene's unit and camera axes (x right, y down, z forward)."""

    alpha: Tensor
    """Accumulated opacity [H, W], 0 to 1."""
    ray_depth: Tensor
    """Expected z [H, W] along the rays; 0 where unobserved."""
    normals: Tensor
    """Unit normals [H, W, 3] towards the camera: blended shortest axes; 0 where unobserved."""
    median_depth: Tensor
    """z [H, W] of the splat at which transmittance falls to 1/2; 0 if it never does."""
    spread: Tensor
    """Standard deviation of z along the ray [H, W], 0 where unobserved. Does not include a systematic error."""
    confidence: Tensor
    """Confidence [H, W], 0 to 1: opacity, reduced where tissue has not been seen (`certainty`)."""
    depth_normals: Tensor
    """Unit normals [H, W, 3] of the surface of `ray_depth`, towards the camera; 0 where unobserved and at edges."""
    semantics: Tensor
    """Blended class logits [H, W, K]; K = 0 for Gaussians without classes."""

    @property
    def observed(self) -> Tensor:
        """Mask [H, W] of pixels with an observed surface."""
        return self.alpha >= COVERED


def certainty(unseen_s: Tensor) -> Tensor:
    """Return the confidence [N] in Gaussians, 0 to 1, from the time [N] in seconds since each was last visible."""
    return 1 / (1 + unseen_s / HALVED_AFTER_S)


def render_rays(gaussians: Gaussians, camera: Camera, values: Tensor | None = None) -> BlendedRays:
    """Blend ray depths, normals and values of the splats; differentiable in the Gaussians and the values.

    The first three of the blended values are the shortest axes of the splats in camera axes, towards the camera. Their
    sum has at most the length of the opacity.

    Args:
        gaussians: Gaussians at one time, float32.
        camera: camera of the result.
        values: further values [N, D] to blend.
    """
    return blend_view_rays(gaussians, view_of(camera, gaussians.device, gaussians.dtype), values)[0]


def view_of(camera: Camera, device: torch.device, dtype: torch.dtype | None = None) -> View:
    """Return a camera with its matrices on a device."""
    viewmat, intrinsics = camera.matrices(device, dtype)
    return View(viewmat, intrinsics, camera.width_px, camera.height_px, camera_model=camera.model)


def blend_view_rays(
    gaussians: Gaussians, view: View, values: Tensor | None = None, capacity: int | None = None
) -> tuple[BlendedRays, Tensor | None]:
    """Render the rays of `render_rays` for a camera whose matrices are on the device.

    Args:
        gaussians: Gaussians at one time, float32.
        view: camera of the result.
        values: further values [N, D] to blend.
        capacity: length of the tile lists, with which a CUDA graph can capture the call; see `bin_splats`. None makes
            them as long as needed.

    Returns:
        The rays, and the required capacity, int64 [1]; None without `capacity`.
    """
    # Imported here, so that rendering only pictures does not load the compiled ops for rays.
    from gsplat_core.ops.ray_blending import MAX_CHANNELS, blend_rays
    from gsplat_core.ops.splat_rays import splat_rays

    scales, opacities = gaussians.scales, gaussians.opacities
    means2d, conics, *lists, needed = _projected(gaussians, scales, opacities, view, capacity)
    rays, normals = splat_rays(gaussians.means, gaussians.quats, scales, view.viewmat, view.K, view.camera_model)
    values = normals if values is None else torch.cat([normals, values], 1)
    blend = lambda part: blend_rays(means2d, conics, opacities, rays, part, view.width, view.height, *lists)
    if values.shape[1] <= MAX_CHANNELS:
        return blend(values), needed
    parts = [blend(part) for part in values.split(MAX_CHANNELS, 1)]
    return parts[0]._replace(values=torch.cat([part.values for part in parts], -1)), needed


def _projected(
    gaussians: Gaussians, scales: Tensor, opacities: Tensor, view: View, capacity: int | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
    """Return means [N, 2] and conics [N, 3] of the splats, starts and ids of the tile lists, and their required
    length if `capacity` is given.
    """
    projected = fully_fused_projection(
        gaussians.means, None, gaussians.quats, scales, view.viewmat[None], view.K[None], view.width, view.height,
        camera_model=view.camera_model, opacities=opacities,
    )  # fmt: skip
    assert isinstance(projected, DenseProjection)
    grid = TileGrid(TILE_SIZE, -(-view.width // TILE_SIZE), -(-view.height // TILE_SIZE))
    splats, conics = (projected.means2d, projected.radii, projected.depths), projected.conics
    needed = None
    with torch.no_grad():
        if capacity is None:
            _, ids, starts = bin_splats(*splats, grid, conics=conics, opacities=opacities[None])
        else:
            _, ids, starts, needed = bin_splats(
                *splats, grid, conics=conics, opacities=opacities[None], capacity=capacity
            )
    return projected.means2d[0], conics[0], starts[0], ids, needed


@torch.no_grad()
def contribution(gaussians: Gaussians, cameras: Iterable[Camera]) -> Tensor:
    """Return the largest blending weight [N] of each Gaussian over all pixels of all views; 0 if it is in none."""
    from gsplat_core.ops.ray_blending import splat_contributions

    scales, opacities = gaussians.scales, gaussians.opacities
    most = torch.zeros_like(opacities)
    for camera in cameras:
        view = view_of(camera, gaussians.device, gaussians.dtype)
        means2d, conics, starts, ids, _ = _projected(gaussians, scales, opacities, view)
        most = torch.maximum(
            most, splat_contributions(means2d, conics, opacities, view.width, view.height, starts, ids)
        )
    return most


LEAST_CONTRIBUTION = 1 / 255
"""Largest blending weight below which a Gaussian changes no pixel of an 8-bit picture."""


def pruned(gaussians: Gaussians, cameras: Iterable[Camera], least: float = LEAST_CONTRIBUTION) -> Gaussians:
    """Return the Gaussians whose `contribution` to at least one view is `least` or more. Synchronises on CUDA."""
    return gaussians.select(contribution(gaussians, cameras) >= least)


@torch.no_grad()
def render_surface(gaussians: Gaussians, camera: Camera, certain: Tensor | None = None) -> Surface:
    """Render the surface seen by `camera`, float32 on the Gaussians' device.

    Args:
        gaussians: Gaussians at one time.
        camera: camera of the outputs.
        certain: confidence [N], 0 to 1, of each Gaussian; None for 1.
    """
    columns = []
    if certain is not None:
        require_shape("certain", certain, (gaussians.count,), "[N]")
        columns.append(certain.to(gaussians.dtype)[:, None])
    logits = gaussians.extra.get(SEMANTICS)
    if logits is not None:
        columns.append(logits)
    rays = render_rays(gaussians, camera, torch.cat(columns, 1) if columns else None)
    observed = rays.alphas >= COVERED
    normals = torch.nn.functional.normalize(rays.values[..., :3], dim=-1)
    depth, median, spread = (
        torch.where(observed, plane, 0) for plane in (rays.depths, rays.medians, rays.variances.sqrt())
    )
    confidence, first_class = (rays.alphas, 3) if certain is None else (rays.values[..., 3], 4)
    return Surface(
        rays.alphas,
        depth,
        torch.where(observed[..., None], normals, 0),
        median,
        spread,
        confidence,
        depth_normals(depth, camera),
        rays.values[..., first_class:],
    )
