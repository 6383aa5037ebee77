"""Rendering with the compiled operations: `rasterization` as in gsplat, and `render` for one camera.

Both run a chain of operations. On CUDA, `SingleCall` renders supported inputs in one native call per pass, with the
same result.
"""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from gsplat_core.ops.arguments import require_shape
from gsplat_core.ops.compositing import rasterize_to_pixels
from gsplat_core.ops.frame import STATUS_NEEDED, STATUS_OVERFLOW, Frame, View, WeightedFrame, render_frame
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.ops.packed_projection import values_of_rows, visible_harmonics
from gsplat_core.ops.projection import fully_fused_projection
from gsplat_core.ops.rasterization import (
    DEPTH_SUM,
    EXPECTED_DEPTH,
    MOST_PIXELS,
    MOST_PLAIN_COLORS,
    NO_DEPTH,
    PLAIN_COLORS,
    Inputs,
    Options,
    Ranges,
    Rasterized,
    rasterize,
)
from gsplat_core.ops.rasterization import View as NativeView
from gsplat_core.ops.spherical_harmonics import spherical_harmonics
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.pipeline import Operations, camera_centers
from gsplat_core.rendering.settings import PLAIN_TENSORS, TILE_SIZE, Arguments, RenderSettings, is_transformed
from gsplat_core.scene.cameras import CAMERA_MODELS, Camera
from gsplat_core.scene.gaussians import Gaussians, require_gaussians
from gsplat_core.transfers import HostCopy

__all__ = ["RenderOutput", "rasterization", "render"]

F = TypeVar("F", Frame, WeightedFrame)


NATIVE_CONSTANTS = "1.6"
"""gsplat version whose constants are compiled into the native call."""
MOST_PACKED_PAIRS = 1 << 23
"""Pairs of camera and Gaussian up to which packed pictures are rendered in the native call, whose scratch memory is dense."""
MOST_RESERVED_ENTRIES = 1 << 22
"""Length of the tile lists up to which memory is reserved before the length is known, at most 28 bytes per entry."""
FEWEST_RESERVED_ENTRIES = 1 << 10
_DEPTH_MODES = {"RGB": NO_DEPTH, "D": DEPTH_SUM, "ED": EXPECTED_DEPTH, "RGB+D": DEPTH_SUM, "RGB+ED": EXPECTED_DEPTH}


def next_capacity(capacity: int, length: int) -> int:
    """Return the capacity of the tile lists for the next call of the same kind, or 0 to wait for their length.

    The capacity is kept while at least an eighth of the length is to spare, so that equal calls allocate equal sizes.
    It falls slowly, because views with long and with short lists may alternate.

    Args:
        capacity: of the last call.
        length: entries that the last call needed.
    """
    if length > MOST_RESERVED_ENTRIES:
        return 0
    if 0 < length + length // 8 <= capacity <= 2 * length:
        return capacity
    return max(length + length // 4 + FEWEST_RESERVED_ENTRIES, capacity - capacity // 16)


class SingleCall:
    """Native call for arguments of one kind: its options, computed once for all calls with the same signature.

    Also reserves memory for the tile lists by their length in the last call, so that the kernels of the next call are
    enqueued before its own length is known.
    """

    def __init__(self, arguments: Arguments, settings: RenderSettings) -> None:
        assert arguments.colors is not None
        viewmats, has_colors = arguments.viewmats, settings.has_colors
        self._differentiable = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in arguments)
        degree = settings.sh_degree if has_colors and settings.sh_degree is not None else PLAIN_COLORS
        self._has_colors = has_colors
        self._has_centers = degree != PLAIN_COLORS and self._differentiable and viewmats.requires_grad
        options = Options(
            width=settings.width,
            height=settings.height,
            camera_model=CAMERA_MODELS.index(settings.camera_model),
            degree=degree,
            channels=arguments.colors.shape[-1] if has_colors else 0,
            depth_mode=_DEPTH_MODES[settings.render_mode],
            antialiased=settings.rasterize_mode == "antialiased",
            packed=settings.packed,
            absgrad=settings.absgrad,
        )
        ranges = Ranges(settings.eps2d, settings.near_plane, settings.far_plane, settings.radius_clip)
        self._view = NativeView(tuple(viewmats.shape[:-2]), options, ranges)

    def __call__(self, arguments: Arguments) -> Rasterized:
        """Render; the host waits once, for the length of the tile lists."""
        means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars, _ = arguments
        triangles = None
        if covars is not None:
            triangles = torch.stack([covars[..., i, j] for i in range(3) for j in range(i, 3)], -1)
            quats = scales = None
        if not self._has_colors:
            colors = backgrounds = None
        centers = camera_centers(viewmats) if self._has_centers else None
        inputs = Inputs(means, triangles, quats, scales, opacities, colors, viewmats, Ks, centers, backgrounds)
        view = self._view
        out = rasterize(inputs, view, self._differentiable)
        capacity = next_capacity(view.options.capacity, out.flatten_ids.shape[0])
        if capacity != view.options.capacity:
            self._view = view._replace(options=view.options._replace(capacity=capacity))
        return out


def single_call(arguments: Arguments, settings: RenderSettings) -> SingleCall | None:
    """Return the native call, whose result is equal to that of the chain of operations.

    None for unsupported or invalid arguments. The chain then renders them or raises the error.
    """
    return SingleCall(arguments, settings) if _takes(arguments, settings) else None


def _takes(arguments: Arguments, settings: RenderSettings) -> bool:
    if CUDA_MISSING is not None or settings.tile_size != TILE_SIZE or is_transformed():
        return False
    if settings.has_distance or settings.normals or not settings.global_z_order:
        return False
    if settings.sparse_grad or settings.distributed:
        return False
    if arguments.extra_signals is not None or arguments.colors is None:
        return False
    if arguments.Ks.requires_grad and torch.is_grad_enabled():
        return False  # the native call has no gradient of the intrinsics
    if settings.constants != NATIVE_CONSTANTS or not _are_plain_cuda_floats(arguments):
        return False
    means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars, _ = arguments
    assert colors is not None
    if means.dim() < 2 or viewmats.dim() < 3 or settings.camera_model not in CAMERA_MODELS:
        return False
    batch, n, c = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    images = c * batch.numel()
    if settings.packed and images * n > MOST_PACKED_PAIRS:
        return False
    if images < 1 or not (0 < settings.width <= MOST_PIXELS and 0 < settings.height <= MOST_PIXELS):
        return False
    tiles = settings.tile_grid[0] * settings.tile_grid[1]
    if images * n >= 2**31 - 1 or images * tiles >= 2**26:
        return False
    if covars is None:
        if quats is None or scales is None or quats.shape != (*batch, n, 4) or scales.shape != (*batch, n, 3):
            return False
    elif covars.shape != (*batch, n, 3, 3):
        return False
    if means.shape[-1] != 3 or opacities.shape != (*batch, n) or viewmats.shape != (*batch, c, 4, 4):
        return False
    if Ks.shape != (*batch, c, 3, 3) or not _has_fitting_colors(colors, (*batch, n), (*batch, c, n), settings):
        return False
    channels = 3 if settings.sh_degree is not None else colors.shape[-1]
    return backgrounds is None or not settings.has_colors or backgrounds.shape == (*batch, c, channels)


def _are_plain_cuda_floats(arguments: Arguments) -> bool:
    """Return True if all tensors are plain float32 on one CUDA device."""
    device = arguments.means.device
    if device.type != "cuda":
        return False
    for tensor in arguments:
        if tensor is None:
            continue
        if type(tensor) not in PLAIN_TENSORS or tensor.dtype is not torch.float32 or tensor.device != device:
            return False
    return True


def _has_fitting_colors(
    colors: Tensor, shared: tuple[int, ...], per_camera: tuple[int, ...], settings: RenderSettings
) -> bool:
    if settings.sh_degree is None:
        return colors.shape[:-1] in (shared, per_camera) and 1 <= colors.shape[-1] <= MOST_PLAIN_COLORS
    if colors.dim() < 3 or colors.shape[-1] != 3 or colors.shape[-2] < (settings.sh_degree + 1) ** 2:
        return False
    return colors.shape[:-2] in (shared, per_camera)


def _splat_rays(*arguments: Any) -> tuple[Tensor, Tensor]:
    # Imported here, so that rendering only pictures does not load the op for rays.
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
"""Number of Gaussians assumed for the initial tile-list capacity of smaller scenes, whose few large Gaussians may touch every
tile.
"""


class RenderOutput(NamedTuple):
    """Rendered outputs of one camera; differentiable with respect to the Gaussians."""

    image: Tensor
    """Colours [H, W, 3], 0 to 1 for an ordinary scene (not clamped above)."""
    alpha: Tensor
    """Accumulated opacity [H, W], 0 to 1."""
    depth: Tensor
    """Expected z [H, W] in the scene's unit, weighted by contribution; 0 where alpha is 0."""


@in_plain_mode
def render(gaussians: Gaussians, camera: Camera, background: Tensor | None = None, depth: bool = True) -> RenderOutput:
    """Render the Gaussians from one camera (Kerbl et al. 2023).

    Float32 Gaussians on CUDA without gradients use the fused op `render_frame`, which needs fewer launches.

    Args:
        gaussians: scene.
        camera: camera of the picture.
        background: colour [3]; None for black.
        depth: False skips the depth channel; `RenderOutput.depth` is then 0 (unknown).
    """
    require_gaussians("render", gaussians)
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
    view = View(viewmat, intrinsics, camera.width_px, camera.height_px, background, camera.model)
    frame = with_capacity(gaussians.count, lambda capacity: render_frame(gaussians.left_tensors, None, view, capacity))
    return output_of(frame, depth)


def with_capacity(count: int, draw: Callable[[int], F]) -> F:
    """Return `draw(capacity)` with a capacity of the tile lists that suffices for the frame. Waits for the device.

    Args:
        count: number of Gaussians.
        draw: renders a frame with a given capacity, which may be too small.
    """
    capacity = INSTANCES_PER_GAUSSIAN * max(count, SMALLEST_SCENE)
    while True:
        frame = draw(capacity)
        status = HostCopy(frame.status).numpy()
        if not status[STATUS_OVERFLOW]:
            return frame
        capacity = int(status[STATUS_NEEDED])


def output_of(frame: Frame | WeightedFrame, depth: bool) -> RenderOutput:
    """Return the outputs of a frame; without `depth` all depths are 0."""
    z = frame.image[..., 3] if depth else torch.zeros_like(frame.alphas)
    return RenderOutput(frame.image[..., :3], frame.alphas, z)
