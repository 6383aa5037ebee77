"""The splatting core: Gaussians, cameras, rasterization, deformation, losses, training and file formats.

Names are loaded when they are first used: importing the package alone loads neither torch nor the compiled library, so
`gsplat_core.reference` works where the library was not built.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsplat_core.cameras import Camera
    from gsplat_core.errors import CoreError, InvalidInput
    from gsplat_core.frames import Frame, FrameStatus
    from gsplat_core.gaussians import Gaussians
    from gsplat_core.rendering import RenderOutput, rasterization, render

__all__ = [
    "Camera",
    "CoreError",
    "Frame",
    "FrameStatus",
    "Gaussians",
    "InvalidInput",
    "RenderOutput",
    "rasterization",
    "render",
]

_HOME = {
    "Camera": "cameras",
    "CoreError": "errors",
    "Frame": "frames",
    "FrameStatus": "frames",
    "Gaussians": "gaussians",
    "InvalidInput": "errors",
    "RenderOutput": "rendering",
    "rasterization": "rendering",
    "render": "rendering",
}
"""The module that each public name lives in."""


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
