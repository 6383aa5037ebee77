"""The loss of one rendered frame and its gradient at the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.gaussians import Gaussians
from gsplat_core.rendering import render
from gsplat_core.training.losses import inverse_depth_l1, masked_l1, masked_ssim_loss
from gsplat_core.training.observations import Observation


@dataclass(frozen=True)
class LossWeights:
    """(1 - ssim) L1 + ssim (1 - SSIM) + depth * inverse-depth L1, each over tissue pixels."""

    ssim: float = 0.0
    depth: float = 0.0


def loss_and_gradients(
    gaussians: Gaussians, observation: Observation, weights: LossWeights
) -> tuple[float, dict[str, Tensor]]:
    """Loss against `observation`, and its gradient for each of the Gaussians' five raw tensors, by name."""
    leaves = gaussians.detach().clone().requires_grad_()
    use_depth = weights.depth > 0 and observation.depth is not None
    with torch.enable_grad():
        output = render(leaves, observation.camera, depth=use_depth)
        target = observation.image.to(torch.float32) / 255
        loss = (1 - weights.ssim) * masked_l1(output.image, target, observation.mask)
        if weights.ssim > 0:
            loss = loss + weights.ssim * masked_ssim_loss(output.image, target, observation.mask)
        if use_depth:
            loss = loss + weights.depth * inverse_depth_l1(output.depth, observation.depth, observation.mask)
        loss.backward()
    return float(loss.detach()), {
        name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in leaves.tensors().items()
    }
