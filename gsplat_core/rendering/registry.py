"""Creation of renderers by name."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidSetting
from gsplat_core.rendering.renderer import Precision, Renderer, RendererOptions, check_background, check_choice
from gsplat_core.scene.cameras import Camera

__all__ = ["RENDERERS", "check_renderer", "new_renderer"]


def check_renderer(
    name: str,
    device: torch.device | str = "cpu",
    precision: str = "fp32",
    options: RendererOptions | None = None,
) -> None:
    """Check that a renderer exists and supports the device, the precision and all options that are not the defaults.

    Raises:
        InvalidSetting: otherwise.
    """
    capabilities = RENDERERS[name].capabilities
    check_choice(name, capabilities, torch.device(device), precision)
    for option in () if options is None else options.changed():
        if option not in capabilities.options:
            having = [other for other in RENDERERS if option in RENDERERS[other].capabilities.options]
            raise InvalidSetting(
                f"renderer {name!r} has no option {option}; choose {' or '.join(having) or 'the default'}"
            )


def new_renderer(
    name: str,
    camera: Camera,
    device: torch.device | str = "cpu",
    *,
    precision: Precision = "fp32",
    background: Tensor | None = None,
    options: RendererOptions | None = None,
) -> Renderer:
    """Create a renderer by name for the camera's size and projection.

    Raises:
        InvalidSetting: for an unknown name, or an unsupported device, precision or option.
    """
    check_renderer(name, device, precision, options)
    check_background(background)
    kind: Callable[..., Renderer] = RENDERERS[name]
    own = {"options": options or RendererOptions()} if RENDERERS[name].capabilities.options else {}
    return kind(camera, torch.device(device), precision=precision, background=background, **own)
