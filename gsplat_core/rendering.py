"""Rendering with the compiled operations: `rasterization` as in gsplat, and `render` for one camera."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.cameras import Camera
from gsplat_core.gaussians import Gaussians
from gsplat_core.ops.compositing.compositing import rasterize_to_pixels
from gsplat_core.ops.projection.projection import fully_fused_projection
from gsplat_core.ops.spherical_harmonics.spherical_harmonics import spherical_harmonics
from gsplat_core.ops.tiles.tiles import bin_splats, isect_tiles
from gsplat_core.pipeline import Operations

__all__ = ["RenderOutput", "rasterization", "render"]

rasterization = Operations(
    fully_fused_projection=fully_fused_projection,
    spherical_harmonics=spherical_harmonics,
    isect_tiles=isect_tiles,
    bin_splats=bin_splats,
    rasterize_to_pixels=rasterize_to_pixels,
    passes_no_zeros_on=True,
).rasterization


class RenderOutput(NamedTuple):
    """What one camera sees; differentiable with respect to the Gaussians."""

    image: Tensor
    """Colours [H, W, 3], 0 to 1 for an ordinary scene (not clamped above)."""
    alpha: Tensor
    """Opacity [H, W]."""
    depth: Tensor
    """Expected z [H, W] in the scene's unit: the mean over the splats, weighted by their contribution; 0 where alpha is 0."""


def render(gaussians: Gaussians, camera: Camera, background: Tensor | None = None, depth: bool = True) -> RenderOutput:
    """Render the Gaussians from one camera, in front of `background` [3] (black when None).

    `depth=False` saves the depth channel, and `RenderOutput.depth` is then 0 (unknown) everywhere.
    """
    if background is not None:
        require_shape("background", background, (3,), "[3]")
        background = background[None]
    viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
    colors, alphas, _ = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        viewmat[None],
        intrinsics[None],
        camera.width_px,
        camera.height_px,
        sh_degree=gaussians.sh_degree,
        packed=False,
        backgrounds=background,
        render_mode="RGB+ED" if depth else "RGB",
        camera_model=camera.model,
    )
    alpha = alphas[0, ..., 0]
    z = colors[0, ..., 3] if depth else alpha.new_zeros(alpha.shape)
    return RenderOutput(colors[0, ..., :3], alpha, z)
