"""Rendering with the compiled operations: `rasterization` as in gsplat, and `render` for one camera."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Collection
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.arguments import require_shape
from gsplat_core.ops.compositing import rasterize_to_pixels
from gsplat_core.ops.frame import STATUS_NEEDED, STATUS_OVERFLOW, View, render_frame
from gsplat_core.ops.packed_projection import values_of_rows, visible_harmonics
from gsplat_core.ops.projection import fully_fused_projection
from gsplat_core.ops.spherical_harmonics import spherical_harmonics
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.pipeline import Operations
from gsplat_core.rendering.settings import Arguments, RenderSettings
from gsplat_core.rendering.single_call import single_call
from gsplat_core.rendering.torch_modes import in_plain_mode
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.transfers import HostCopy

__all__ = ["RenderOutput", "rasterization", "render"]


def _splat_rays(*arguments: Any) -> tuple[Tensor, Tensor]:
    # The op is loaded when it is first needed, so that pictures alone do not depend on it.
    from gsplat_core.ops.splat_rays import splat_rays

    return splat_rays(*arguments)


def _blend_rays(*arguments: Any, **options: Any) -> tuple[Tensor, ...]:
    from gsplat_core.ops.ray_blending import blend_rays

    return blend_rays(*arguments, **options)


step_by_step = Operations(
    fully_fused_projection=fully_fused_projection,
    spherical_harmonics=spherical_harmonics,
    bin_splats=bin_splats,
    rasterize_to_pixels=rasterize_to_pixels,
    splat_rays=_splat_rays,
    blend_rays=_blend_rays,
    values_of_rows=values_of_rows,
    visible_harmonics=visible_harmonics,
    zero_gradients_stay_zero=True,
)
"""Rendering pipeline as a chain of separate compiled operations, on any supported device."""
_operations = replace(step_by_step, single_call=single_call)
_PARAMETERS = inspect.signature(_operations.rasterization).parameters
_POSITIONAL = [name for name, each in _PARAMETERS.items() if each.kind is each.POSITIONAL_OR_KEYWORD]
_REQUIRED = [name for name in _POSITIONAL if _PARAMETERS[name].default is inspect.Parameter.empty]


@functools.wraps(_operations.rasterization)
@in_plain_mode
def rasterization(*arguments: Any, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    # Signature and docstring are copied from `Operations.rasterization`. Calling that method
    # directly would put its name into argument errors.
    try:
        return _operations.rasterization(*arguments, **options)
    except TypeError:
        wrong = _wrong_names(len(arguments), options.keys())
        if wrong is None:
            raise
    raise TypeError(wrong)


rasterization.__module__, rasterization.__qualname__ = __name__, "rasterization"  # so that it can be pickled


def _wrong_names(positional: int, named: Collection[str]) -> str | None:
    """Return a sentence about arguments of `rasterization` that are unknown, too many, given twice or missing; None if
    there are none.
    """
    for name in named:
        if name not in _PARAMETERS:
            close = difflib.get_close_matches(name, _PARAMETERS, n=3, cutoff=0.5)
            advice = f"did you mean {' or '.join(close)}?" if close else f"it takes {', '.join(_PARAMETERS)}"
            return f"rasterization() has no argument {name!r}; {advice}"
    if positional > len(_POSITIONAL):
        return f"rasterization() takes at most {len(_POSITIONAL)} arguments by position, got {positional}"
    twice = [name for name in _POSITIONAL[:positional] if name in named]
    if twice:
        return f"rasterization() got {', '.join(twice)} by position and by name; give it once"
    missing = [name for name in _REQUIRED[positional:] if name not in named]
    if missing:
        return f"rasterization() needs {', '.join(missing)}; {', '.join(_REQUIRED)} are required"
    return None


INSTANCES_PER_GAUSSIAN = 8
"""Initial capacity of the tile lists per Gaussian; larger frames are rendered again."""
SMALLEST_SCENE = 1 << 14
"""Minimum number of Gaussians for the capacity, because few large ones may touch every tile."""


class RenderOutput(NamedTuple):
    """Rendered outputs of one camera; differentiable with respect to the Gaussians."""

    image: Tensor
    """Colours [H, W, 3], 0 to 1 for an ordinary scene (not clamped above)."""
    alpha: Tensor
    """Accumulated opacity [H, W], 0 to 1."""
    depth: Tensor
    """Expected z [H, W] in the scene's unit, weighted by contribution; 0 where alpha is 0."""


def render(gaussians: Gaussians, camera: Camera, background: Tensor | None = None, depth: bool = True) -> RenderOutput:
    """Render the Gaussians from one camera (Kerbl et al. 2023).

    Float32 Gaussians on CUDA without gradients use the fused op `render_frame`, which needs fewer launches.

    Args:
        gaussians: scene.
        camera: camera of the picture.
        background: colour [3]; None for black.
        depth: False skips the depth channel; `RenderOutput.depth` is then 0 (unknown).
    """
    if background is not None:
        require_shape("background", background, (3,), "[3]")
    viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
    followed = torch.is_grad_enabled() and any(
        t.requires_grad for t in (*gaussians.left_tensors, background) if t is not None
    )
    if gaussians.device.type == "cuda" and gaussians.dtype == torch.float32 and not followed:
        return _render_frame(gaussians, camera, viewmat, intrinsics, background, depth)
    settings = RenderSettings(
        width=camera.width_px, height=camera.height_px, sh_degree=gaussians.sh_degree,
        render_mode="RGB+ED" if depth else "RGB", camera_model=camera.model,
    )  # fmt: skip
    behind = None if background is None else background[None]
    colors, alphas = _operations.pictures(
        Arguments(
            gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, viewmat[None],
            intrinsics[None], behind, None,
        ),
        settings,
    )  # fmt: skip
    alpha = alphas[0, ..., 0]
    z = colors[0, ..., 3] if depth else alpha.new_zeros(alpha.shape)
    return RenderOutput(colors[0, ..., :3], alpha, z)


def _render_frame(
    gaussians: Gaussians, camera: Camera, viewmat: Tensor, intrinsics: Tensor, background: Tensor | None, depth: bool
) -> RenderOutput:
    capacity = INSTANCES_PER_GAUSSIAN * max(gaussians.count, SMALLEST_SCENE)
    view = View(viewmat, intrinsics, camera.width_px, camera.height_px, background, camera.model)
    while True:
        frame = render_frame(gaussians.left_tensors, None, view, capacity)
        status = HostCopy(frame.status).numpy()
        if not status[STATUS_OVERFLOW]:
            z = frame.image[..., 3] if depth else torch.zeros_like(frame.alphas)
            return RenderOutput(frame.image[..., :3], frame.alphas, z)
        capacity = int(status[STATUS_NEEDED])
