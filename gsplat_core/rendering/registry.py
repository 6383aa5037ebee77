"""Registry of renderers."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.registry import Registry
from gsplat_core.rendering.renderer import Precision, Renderer, RendererKind, check_background, check_choice
from gsplat_core.scene.cameras import Camera

RENDERERS: Registry[RendererKind] = Registry("renderer", {"alpha": "gsplat_core.rendering.alpha:AlphaRenderer"})
"""Renderers by name; "alpha" is alpha blending (Kerbl et al. 2023).

CONTRIBUTING.md, "A renderer", describes how to add one.
"""


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
