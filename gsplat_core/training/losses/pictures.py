"""Colour and depth terms of the fused image loss as losses of their own."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from gsplat_core.ops.image_loss import image_loss
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.observations import Observation


class Photometric:
    """L1 difference of the colours over tissue.

    Every step computes this term by the fused path of `image_loss`, with the settings `ssim_weight` and
    `squared_error`. This class evaluates it alone.
    """

    name: ClassVar[str] = "photometric"
    default_weight: ClassVar[float] = 1.0

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean absolute colour difference between the rendered picture and the observation over tissue."""
        output = render(scene, observation.camera, depth=False)
        return image_loss(output.image, observation.image, observation.mask).loss


class Depth:
    """Mean absolute difference of inverse depths over tissue of known depth, in 1/mm.

    Every step computes this term by the fused path of `image_loss`, with the setting `depth_weight`. This class
    evaluates it alone.
    """

    name: ClassVar[str] = "depth"
    default_weight: ClassVar[float] = 1.0

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean absolute difference of inverse depths; None for an observation without depth."""
        if observation.depth is None:
            return None
        output = render(scene, observation.camera)
        image = output.image.detach()
        result = image_loss(image, observation.image, observation.mask, output.depth, observation.depth, 0.0, 1.0)
        return result.loss - image_loss(image, observation.image, observation.mask).loss
