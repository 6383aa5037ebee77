"""Creation of renderers by name."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.choices import RENDERERS
from gsplat_core.rendering.renderer import Precision, Renderer, check_background, check_choice
from gsplat_core.scene.cameras import Camera

__all__ = ["RENDERERS", "check_renderer", "new_renderer"]


def check_renderer(name: str, device: torch.device | str = "cpu", precision: str = "fp32") -> None:
    """Check that a renderer exists and supports the device and precision.

    Raises:
        InvalidSetting: otherwise.
    """
    check_choice(name, RENDERERS[name].capabilities, torch.device(device), precision)


def new_renderer(
    name: str,
    camera: Camera,
    device: torch.device | str = "cpu",
    *,
    precision: Precision = "fp32",
    background: Tensor | None = None,
) -> Renderer:
    """Create a renderer by name for the camera's size and projection.

    Raises:
        InvalidSetting: for an unknown name, or an unsupported device or precision.
    """
    check_renderer(name, device, precision)
    check_background(background)
    return RENDERERS[name](camera, torch.device(device), precision=precision, background=background)
