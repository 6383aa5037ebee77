"""Mean opacity and mean scale of the Gaussians, which let unnecessary ones fade (Kheradmand et al. 2024, section 3.4)."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.growth.unseen import depth_of
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.observations import Observation


class MeanOpacity:
    """Mean opacity of all Gaussians."""

    name: ClassVar[str] = "opacity"
    default_weight: ClassVar[float] = 0.01

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean opacity of the scene's Gaussians, None without Gaussians; the observation is not read."""
        return scene.opacities.mean() if scene.count else None


class MeanScale:
    """Mean standard deviation of all Gaussians, relative to the scene's distance from the camera of the first
    observation.
    """

    name: ClassVar[str] = "scale"
    default_weight: ClassVar[float] = 0.01

    def __init__(self) -> None:
        self._distance: Tensor | None = None

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean standard deviation of the scene's Gaussians, relative to the scene's median distance at the
        first call; None without Gaussians.
        """
        if not scene.count:
            return None
        if self._distance is None:
            self._distance = depth_of(scene.means.detach(), observation.camera).abs().median()
        return scene.scales.mean() / self._distance
