"""Ray depths, normals and class logits of the scene, rendered once for all losses that compare them."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from gsplat_core.rendering.surface import COVERED, SEMANTICS, render_rays
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.observations import Observation

SMALL_PIXELS = 24_000
"""Number of pixels up to which pictures are compared at full size."""


EVERY = 4
"""Interval in steps at which the losses of rays render; the loss of such a step is multiplied by this number. All
losses of rays use the same steps.
"""


class Turns:
    """Counter of a loss's evaluations, of which one in `EVERY` is computed."""

    def __init__(self) -> None:
        self._calls = 0

    def is_due(self) -> bool:
        """Return True in one of `EVERY` calls, from the first on."""
        self._calls += 1
        return (self._calls - 1) % EVERY == 0


class RenderedRays(NamedTuple):
    """Values of the rays of an observation at the compared size [h, w]."""

    camera: Camera
    stride: int
    """Pixels of the observation per compared pixel along each axis."""
    alphas: Tensor
    depths: Tensor
    normals: Tensor
    """Sum of weight times normal [h, w, 3]; its length is at most the opacity."""
    logits: Tensor
    """Sum of weight times class logits [h, w, K]; K = 0 for Gaussians without classes."""
    tissue: Tensor
    """Mask bool [h, w] of observed pixels that are tissue."""

    def sampled(self, plane: Tensor) -> Tensor:
        """Return a plane [H, W] of the observation at the compared pixels."""
        height, width = self.alphas.shape
        return plane[:: self.stride, :: self.stride][:height, :width]


def rays_of(scene: Gaussians, observation: Observation, context: LossContext) -> RenderedRays:
    """Render the rays of an observation. Pictures of more than `SMALL_PIXELS` pixels are rendered at half size.

    The centre of every compared pixel is that of the observation's pixel with even row and column.
    """
    known = context.shared.get("rays")
    if isinstance(known, RenderedRays):
        return known
    camera = observation.camera
    stride = 1 if camera.width_px * camera.height_px <= SMALL_PIXELS else 2
    if stride > 1:
        K = camera.K.copy()
        K[:2] /= stride
        K[:2, 2] += 0.5 - 0.5 / stride
        camera = Camera(K, camera.width_px // stride, camera.height_px // stride, camera.world_to_camera, camera.model)
    rays = render_rays(scene, camera, scene.extra.get(SEMANTICS))
    unmasked = RenderedRays(
        camera, stride, rays.alphas, rays.depths, rays.values[..., :3], rays.values[..., 3:], rays.alphas >= COVERED
    )
    made = unmasked._replace(tissue=unmasked.tissue & (unmasked.sampled(observation.mask) != 0))
    context.shared["rays"] = made
    return made
