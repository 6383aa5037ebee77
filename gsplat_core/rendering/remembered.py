"""How much of a picture is remembered: tissue that was there when the camera saw it last, and that it does not see now."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_shape
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.scene.model import Model


def share_of(gaussians: Gaussians, chosen: Tensor, camera: Camera) -> Tensor:
    """How much of what each pixel shows, [H, W] from 0 to 1, is of the chosen Gaussians, bool [N]; 0 where nothing is shown."""
    require_shape("chosen", chosen, (gaussians.count,), "[N]")
    colours = (chosen.to(gaussians.dtype) - 0.5) / SH_C0
    with torch.no_grad():
        seen = render(replace(gaussians, sh=colours[:, None, None].expand(-1, 1, 3).contiguous()), camera, depth=False)
    return torch.where(seen.alpha > 0, seen.image[..., 0] / seen.alpha.clamp(min=1e-6), 0).clamp(0, 1)


def remembered_share(model: Model, camera: Camera, time_s: float) -> Tensor:
    """How much of what each pixel shows from any camera, [H, W] from 0 to 1, nobody saw when that was looked at last.

    0 everywhere for a model of which that is not known.
    """
    gaussians = model.at(time_s)
    if model.unseen_s is None:
        return gaussians.means.new_zeros(camera.height_px, camera.width_px)
    return share_of(gaussians, model.unseen_s > 0, camera)
