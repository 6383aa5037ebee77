"""Share of a picture that is remembered: tissue seen earlier but not visible to the camera now."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians


def share_of(gaussians: Gaussians, chosen: Tensor, camera: Camera) -> Tensor:
    """Return each pixel's share of chosen Gaussians in the blended weight.

    Args:
        gaussians: all Gaussians.
        chosen: bool [N].
        camera: camera of the picture.

    Returns:
        [H, W] in 0..1; 0 where nothing is rendered.
    """
    require_shape("chosen", chosen, (gaussians.count,), "[N]")
    colours = (chosen.to(gaussians.dtype) - 0.5) / SH_C0
    with torch.no_grad():
        seen = render(replace(gaussians, sh=colours[:, None, None].expand(-1, 1, 3).contiguous()), camera, depth=False)
    return torch.where(seen.alpha > 0, seen.image[..., 0] / seen.alpha.clamp(min=1e-6), 0).clamp(0, 1)
