"""Selection of losses by name, and their weighted sum."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from gsplat_core.choices import LOSSES
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import ExtendingLoss, Loss, LossContext, RayLoss
from gsplat_core.training.losses.rendered_rays import EVERY, RenderedRays, rays_of
from gsplat_core.training.observations import Observation

__all__ = ["LOSSES", "WeightedLosses", "loss_weights"]

ALWAYS_COMPARED = {"photometric": "ssim_weight and squared_error", "depth": "depth_weight"}
"""Losses that every step computes by the fused path, with the settings that weigh them."""


def loss_weights(chosen: Sequence[str]) -> dict[str, float]:
    """Return the weights of the losses that are added to the fused path, by name.

    Args:
        chosen: losses as `name` or `name:weight`, for example `normal_consistency:0.05`.

    Raises:
        InvalidSetting: for an unknown loss, a repeated loss, a weight that is not a positive number, or a weight for a
            loss of the fused path.
    """
    weights: dict[str, float] = {}
    for each in chosen:
        name, colon, given = each.partition(":")
        LOSSES.check(name)
        if name in ALWAYS_COMPARED:
            if colon:
                raise InvalidSetting(
                    f"losses has {each!r}; {name} is always compared and weighed by {ALWAYS_COMPARED[name]}, so write"
                    f" {name!r} or leave it out"
                )
            continue
        if name in weights:
            raise InvalidSetting(
                f"losses names {name!r} twice; name it once, as {name}:{LOSSES[name].default_weight:g}"
            )
        weights[name] = _weight(each, given) if colon else LOSSES[name].default_weight
    return weights


def _weight(loss: str, given: str) -> float:
    try:
        weight = float(given)
    except ValueError:
        weight = math.nan
    if not 0 < weight < math.inf:
        raise InvalidSetting(
            f"losses has {loss!r}; the weight after the colon must be a positive number, as in name:0.1"
        )
    return weight


class WeightedLosses:
    """Weighted sum of the chosen losses for one scene."""

    def __init__(self, weights: dict[str, float]) -> None:
        """Create the losses with these weights by name, the result of `loss_weights`."""
        made = [(LOSSES[name](), weight) for name, weight in weights.items()]
        self._of_rays = [(loss, weight) for loss, weight in made if isinstance(loss, RayLoss)]
        self._terms: list[tuple[Loss, float]] = [
            (loss, weight) for loss, weight in made if not isinstance(loss, RayLoss)
        ]
        self._steps = 0

    def __bool__(self) -> bool:
        return bool(self._terms or self._of_rays)

    @property
    def can_be_captured(self) -> bool:
        """True if a CUDA graph can capture all losses, by `compare`."""
        return not self._terms

    def extended(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with the tensors that the losses train."""
        for loss, _ in self._terms:
            if isinstance(loss, ExtendingLoss):
                gaussians = loss.extended(gaussians)
        return gaussians

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates of the tensors that the losses train, by name in `Gaussians.extra`."""
        extending = [loss for loss, _ in self._terms if isinstance(loss, ExtendingLoss)]
        return {name: rate for loss in extending for name, rate in loss.rates.items()}

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the weighted sum, see `Loss.__call__`; None if no loss has anything to compare."""
        total = self.compare(rays_of(scene, observation)) if self.are_rays_due(observation) else None
        for loss, weight in self._terms:
            value = loss(scene, observation, context)
            if value is not None:
                total = weight * value if total is None else total + weight * value
        return total

    def are_rays_due(self, observation: Observation) -> bool:
        """Return True if this step compares the rays of the observation. Called once per step."""
        self._steps += 1
        has_depth = observation.depth is not None
        compared = any(has_depth or not loss.needs_depth for loss, _ in self._of_rays)
        return compared and (self._steps - 1) % EVERY == 0

    def compare(self, rays: RenderedRays) -> Tensor:
        """Return the weighted sum of the losses along rays for a step that compares them.

        Args:
            rays: rays for which `are_rays_due` returned True.
        """
        has_depth = rays.known_depth is not None
        terms = [
            (EVERY * weight) * loss.compare(rays) for loss, weight in self._of_rays if has_depth or not loss.needs_depth
        ]
        return sum(terms[1:], start=terms[0])
