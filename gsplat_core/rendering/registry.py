"""Creation of renderers by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidSetting
from gsplat_core.models.model import Model
from gsplat_core.rendering.rasterization import RenderOutput
from gsplat_core.rendering.renderer import (
    Precision,
    Renderer,
    RendererOptions,
    TrainableRenderer,
    check_background,
    check_choice,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

__all__ = ["RENDERERS", "check_renderer", "new_renderer", "picture_of"]


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


def picture_of(
    model: Model, gaussians: Gaussians, camera: Camera, background: Tensor | None = None, depth: bool = True
) -> RenderOutput:
    """Render Gaussians by the renderer that trained a model, with its values. Differentiable in the Gaussians.

    Args:
        model: model whose `trained_by` names the renderer.
        gaussians: the model's Gaussians at one time, or a change of them.
        camera: camera of the picture.
        background: colour [3]; None for black.
        depth: False skips the depth, which is then 0 (unknown).
    """
    kind = cast(TrainableRenderer, RENDERERS[model.trained_by.renderer])
    values = {name: gaussians.means.new_tensor(value) for name, value in model.trained_by.values.items()}
    return kind.picture(gaussians, camera, background, values, depth)


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
