"""Gaussians with what a deformation field adds to them."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.layout import COLOUR, LOG_SCALE, OPACITY, POSITION, ROTATION


def displaced(gaussians: Gaussians, deltas: Tensor) -> Gaussians:
    """The Gaussians with `deltas` added, whole raw rows [N, 16], or [N, 13] without opacity; differentiable in both. What nothing is added to
    shares memory with what it was."""
    sh = gaussians.sh
    base = sh[:, :1] + deltas[:, None, COLOUR]
    opacities = gaussians.logit_opacities
    return Gaussians(
        means=gaussians.means + deltas[:, POSITION],
        quats=gaussians.quats + deltas[:, ROTATION],
        log_scales=gaussians.log_scales + deltas[:, LOG_SCALE],
        logit_opacities=opacities if deltas.shape[1] < OPACITY.stop else opacities + deltas[:, OPACITY.start],
        sh=base if sh.shape[1] == 1 else torch.cat([base, sh[:, 1:]], dim=1),
        right_sh=gaussians.right_sh,
    )
