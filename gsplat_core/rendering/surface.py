"""Surface seen by a camera: depth along each ray, normal, and confidence."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.ops.compositing.compositing import rasterize_to_pixels
from gsplat_core.rendering.settings import TILE_SIZE
from gsplat_core.rendering.splat_planes import SplatPlanes, TileLists, splat_planes, tile_lists
from gsplat_core.rendering.tile_blending import along_rays
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

COVERED = 0.1
"""Minimum opacity of an observed pixel."""
HALVED_AFTER_S = 5.0
"""Time in seconds after which the confidence in unseen tissue is 1/2; it is 1/3 after
twice that.
"""


class Surface(NamedTuple):
    """Surface seen by one camera, in the scene's unit and camera axes (x right, y down,
    z forward).
    """

    alpha: Tensor
    """Opacity [H, W]."""
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
    """Return the confidence [N] in Gaussians, 0 to 1, by the time [N] in seconds since
    last seen.
    """
    return 1 / (1 + unseen_s / HALVED_AFTER_S)


SURFACE_OUTPUTS = tuple(name for name in Surface._fields if name != "alpha")
"""Outputs that a renderer offers in addition to picture, opacity and centre depth."""


@torch.no_grad()
def render_surface(gaussians: Gaussians, camera: Camera, certain: Tensor | None = None) -> Surface:
    """Render the surface seen by `camera`, float32 on the Gaussians' device.

    Much slower than a picture; see `tile_blending`.

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
    """Blend per-splat values [H, W, 6 or 7] (depth plane, normal, certainty) and the opacity [H,
    W].
    """
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
