"""`rasterization()` in one native call per pass, for supported inputs on CUDA."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.ops.native import CUDA_MISSING
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
    View,
    rasterize,
)
from gsplat_core.ops.rasterization import TILE_SIZE as NATIVE_TILE_SIZE
from gsplat_core.rendering.pipeline import camera_centers
from gsplat_core.rendering.settings import PLAIN_TENSORS, Arguments, RenderSettings, is_transformed
from gsplat_core.scene.cameras import CAMERA_MODELS

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
        self._view = View(tuple(viewmats.shape[:-2]), options, ranges)

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
    if CUDA_MISSING is not None or settings.tile_size != NATIVE_TILE_SIZE or is_transformed():
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
