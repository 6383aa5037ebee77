"""Interface of the loss terms of training."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

from torch import Tensor

from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.rendered_rays import RenderedRays
from gsplat_core.training.observations import Observation


@dataclass(frozen=True)
class LossContext:
    """Data other than the observation that a loss may read."""

    frames: Sequence[Observation]
    """Observations available for training in temporal order, including the current one."""
    at: Callable[[float], Gaussians]
    """Function that returns the scene at another time in seconds, without gradients."""


class Loss(Protocol):
    """Loss term, created once per scene. It may keep values that it computed from observations."""

    name: ClassVar[str]
    """Name in `LOSSES`."""
    default_weight: ClassVar[float]
    """Factor of the term if the user gives none."""

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Compare the scene with an observation.

        Args:
            scene: Gaussians at the observation's time in the colours of its eye; their tensors require gradients.
            observation: target.
            context: further observations, and the scene at other times.

        Returns:
            Scalar on the scene's device, differentiable in the scene's tensors. None if the observation has nothing
            to compare.
        """


@runtime_checkable
class RayLoss(Protocol):
    """Loss term of the rendered surface, without state. A CUDA graph captures the training step with its other parts.

    The rays are rendered once for all such losses, in one of `EVERY` steps. The weighted loss of that step is
    multiplied by `EVERY`.
    """

    name: ClassVar[str]
    """Name in `LOSSES`."""
    default_weight: ClassVar[float]
    """Factor of the term if the user gives none."""
    needs_depth: ClassVar[bool]
    """True if only observations with depth are compared."""

    def compare(self, rays: RenderedRays) -> Tensor:
        """Compare the rays of one observation by operations on the device.

        Args:
            rays: rendered rays, differentiable in the scene, and values of the observation. Unknown depth is 0.

        Returns:
            Differentiable scalar on the scene's device, 0 if there is nothing to compare. The host may not read a value
            of the device or copy one to it.
        """


@runtime_checkable
class ExtendingLoss(Protocol):
    """Loss that trains tensors of its own in `Gaussians.extra`."""

    rates: ClassVar[Mapping[str, float]]
    """Learning rates of the loss's tensors by name."""

    def extended(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with the loss's tensors; present ones are unchanged."""


class LossKind(Protocol):
    """Registry entry of a loss, usually its class."""

    name: ClassVar[str]
    default_weight: ClassVar[float]

    def __call__(self) -> Loss | RayLoss:
        """Create the loss for a new scene."""
