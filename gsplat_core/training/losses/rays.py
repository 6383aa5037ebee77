"""Losses along rays: depth and normals. The rays of a step are rendered once for all of them.

Normals are compared with those of the rendered depth (Huang et al. 2024, "2D Gaussian Splatting").
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

from torch import Tensor

from gsplat_core.ops.arguments import View
from gsplat_core.ops.ray_losses import ray_depth_loss, ray_normal_loss
from gsplat_core.rendering.surface import COVERED, blend_view_rays, view_of
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.observations import Observation

SMALL_PIXELS = 24_000
"""Number of pixels up to which pictures are compared at full size."""
EVERY = 8
"""Interval in steps at which losses along rays are evaluated. 4 and 8 have equal accuracy on synthetic stereo recordings
(benchmarks/results/methods.md)."""


class RenderedRays(NamedTuple):
    """Values of the rays of an observation at the compared size [h, w]."""

    view: View
    """Camera of the compared pixels."""
    stride: int
    """Pixels of the observation per compared pixel along each axis."""
    alphas: Tensor
    depths: Tensor
    normals: Tensor
    """Sum of weight times normal [h, w, 3]; its length is at most the opacity."""
    values: Tensor
    """Sum of weight times further value of the splats [h, w, K]."""
    tissue: Tensor
    """Mask bool [h, w] of observed pixels that are tissue."""
    known_depth: Tensor | None
    """Depth [h, w] of the observation, 0 where unknown; None for an observation without depth."""

    def sampled(self, plane: Tensor) -> Tensor:
        """Return a plane [H, W] of the observation at the compared pixels."""
        return _sampled(plane, self.view, self.stride)


def rays_of(scene: Gaussians, observation: Observation, values: Tensor | None = None) -> RenderedRays:
    """Render the rays of an observation.

    Args:
        scene: Gaussians at the observation's time.
        observation: camera, mask and depth.
        values: further values [N, K] of the splats to blend.
    """
    view = view_of(observation.camera, scene.device)
    return compared_rays(scene, view, observation.mask, observation.depth, values)[0]


def compared_rays(
    scene: Gaussians,
    view: View,
    mask: Tensor,
    depth: Tensor | None,
    values: Tensor | None = None,
    capacity: int | None = None,
) -> tuple[RenderedRays, Tensor | None]:
    """Render the rays of a view. Pictures of more than `SMALL_PIXELS` pixels are rendered at half size.

    The centre of a compared pixel is then that of the observation's pixel with even row and column.

    Args:
        scene: Gaussians at the observation's time.
        view: camera of the observation.
        mask: mask [H, W] of the observation, not 0 for tissue.
        depth: depth [H, W] of the observation, 0 where unknown.
        values: further values [N, K] of the splats to blend.
        capacity: as in `blend_view_rays`.

    Returns:
        The rays, and the required capacity as in `blend_view_rays`.
    """
    stride = 1 if view.width * view.height <= SMALL_PIXELS else 2
    if stride > 1:
        K = view.K.clone()
        K[:2].div_(stride)
        K[:2, 2].add_(0.5 - 0.5 / stride)
        view = view._replace(K=K, width=view.width // stride, height=view.height // stride)
    rays, needed = blend_view_rays(scene, view, values, capacity)
    tissue = (rays.alphas >= COVERED) & (_sampled(mask, view, stride) != 0)
    known = None if depth is None else _sampled(depth, view, stride)
    normals = rays.values if values is None else rays.values[..., :3]
    further = rays.values[..., 3:]
    return RenderedRays(view, stride, rays.alphas, rays.depths, normals, further, tissue, known), needed


def _sampled(plane: Tensor, view: View, stride: int) -> Tensor:
    return plane[::stride, ::stride][: view.height, : view.width]


class RayDepth:
    """Mean absolute difference of inverse depths over tissue of known depth, times the observation's mean depth.

    `depth` compares the depths of the Gaussians' centres. On tilted tissue the centres in front hide those behind, so
    they are biased towards the camera, and the fit compensates. The depth along the ray has no such bias and moves the
    rotations and scales, too.
    """

    name: ClassVar[str] = "ray_depth"
    default_weight: ClassVar[float] = 0.2
    needs_depth: ClassVar[bool] = True

    def compare(self, rays: RenderedRays) -> Tensor:
        """Return the mean difference of inverse ray depths, relative to the mean inverse depth of the observation."""
        assert rays.known_depth is not None
        return ray_depth_loss(rays.depths, rays.known_depth, rays.tissue)


class NormalConsistency:
    """Mean of 1 - (splat normal · depth normal), weighted by the blending weights, over tissue.

    It needs no depth of the observation. It flattens bumps and turns Gaussians into the surface.
    """

    name: ClassVar[str] = "normal_consistency"
    default_weight: ClassVar[float] = 0.1
    needs_depth: ClassVar[bool] = False

    def compare(self, rays: RenderedRays) -> Tensor:
        """Return the mean difference of both kinds of normals over the observation's tissue."""
        view = rays.view
        return ray_normal_loss(rays.depths, rays.alphas, rays.normals, rays.tissue, view.K, view.camera_model)
