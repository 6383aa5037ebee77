"""Selection of losses by name, and their weighted sum."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from gsplat_core.choices import LOSSES
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import ExtendingLoss, LossContext
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
        self._terms = [(LOSSES[name](), weight) for name, weight in weights.items()]

    def __bool__(self) -> bool:
        return bool(self._terms)

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
        total: Tensor | None = None
        for loss, weight in self._terms:
            value = loss(scene, observation, context)
            if value is not None:
                total = weight * value if total is None else total + weight * value
        return total
