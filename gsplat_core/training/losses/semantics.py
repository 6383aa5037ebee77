"""Cross-entropy of the rendered classes with labels of an observation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.rendering.surface import SEMANTICS
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.losses.loss import LossContext
from gsplat_core.training.losses.rays import rays_of
from gsplat_core.training.observations import Observation

CLASSES = 4
"""Number of classes of a scene; labels are 0 to 3."""


class Semantics:
    """Mean cross-entropy of the rendered classes over labelled pixels. Only frames with `Frame.labels` are compared.

    A scene that is trained with this loss has the logits `Gaussians.extra["semantics"]` [N, 4]. They move with the
    Gaussians, so labels on a few frames classify all frames. Colours and geometry receive no gradient. Pixels of tools are
    compared, too, where they have a label.
    """

    name: ClassVar[str] = SEMANTICS
    default_weight: ClassVar[float] = 1.0
    rates: ClassVar[Mapping[str, float]] = {SEMANTICS: 0.05}

    def extended(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with logits, 0 for those without."""
        if SEMANTICS in gaussians.extra:
            return gaussians
        logits = gaussians.means.new_zeros(gaussians.count, CLASSES)
        return replace(gaussians, extra={**gaussians.extra, SEMANTICS: logits})

    def __call__(self, scene: Gaussians, observation: Observation, context: LossContext) -> Tensor | None:
        """Return the mean cross-entropy over the observation's labelled pixels; None without labels."""
        if observation.labels is None:
            return None
        geometry = replace(scene.detach(), extra={})
        rays = rays_of(geometry, observation, scene.extra[SEMANTICS])
        labels = rays.sampled(observation.labels).long()
        known = labels < CLASSES
        target = torch.where(known, labels, 0)
        off = torch.nn.functional.cross_entropy(rays.values.permute(2, 0, 1)[None], target[None], reduction="none")[0]
        return torch.where(known, off, 0).sum() / known.sum().clamp(min=1)
