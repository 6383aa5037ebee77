"""Interface of the loss terms of training."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, runtime_checkable

from torch import Tensor

from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.observations import Observation


@dataclass(frozen=True)
class LossContext:
    """Data other than the observation that a loss may read."""

    frames: Sequence[Observation]
    """Observations available for training in temporal order, including the current one."""
    at: Callable[[float], Gaussians]
    """Function that returns the scene at another time in seconds, without gradients."""
    shared: dict[str, object] = field(default_factory=dict)
    """Results that several losses of one evaluation use, by name."""


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

    def __call__(self) -> Loss:
        """Create the loss for a new scene."""
