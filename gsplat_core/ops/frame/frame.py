"""One frame on CUDA from raw Gaussians: deform, activate, project, sort and blend, without a wait of the host.

Splatting after Kerbl et al. 2023 and Zwicker et al. 2001, the same picture as `gsplat_core.rasterization`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_float32, require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native
from gsplat_core.ops.frame import frame_autograd  # noqa: F401  registers the gradient
from gsplat_core.rendering.settings import EPS2D, FAR_PLANE, NEAR_PLANE
from gsplat_core.scene.cameras import CAMERA_MODELS
from gsplat_core.scene.gaussians import MAX_SH_DEGREE
from gsplat_core.scene.layout import RAW_COLUMNS

TILE_SIZE = 16
"""Side of the frame path's tiles in pixels; other sizes are for the plain ops."""
MOST_IN_TILE = 1024
"""Instances for which a tile can have a room of its own."""
STATUS_NEEDED, STATUS_MOST, STATUS_CUT = range(3)
"""Entries of `Frame.status`: instances that the frame needs, most instances in one tile, 1 where some were left out."""


class Frame(NamedTuple):
    """A frame, and what its gradient needs. The instances of a splat are its pairs with the tiles it touches."""

    image: Tensor
    """[H, W, 4]: red, green, blue in front of the background, and depth: the expected z, or the sum of weight and z if training."""
    alphas: Tensor
    """[H, W]."""
    last: Tensor
    """int32 [H, W]: the position in `sorted` of the last instance blended, -1 where there is none. Empty unless training."""
    records: Tensor
    """[N, 12]: the projected splats as the kernels keep them; rows of culled Gaussians are not written. A colour of exactly 0
    was clamped. Columns: x, y, and log2 of alpha's polynomial (xx, xy, yy, 1), infinity, red, green, blue, z, 0."""
    tile_offsets: Tensor
    """int32 [tiles + 1]: where each tile's instances start in `sorted`. Empty with `per_tile`."""
    sorted: Tensor
    """int32 [capacity]: instances by tile and depth. Empty unless training; -1 where the lists were cut."""
    splat_starts: Tensor
    """int32 [N + 1]: where each splat's instances start. Empty unless training."""
    instance_splats: Tensor
    """int32 [capacity]: the splat of every instance. Empty unless training."""
    status: Tensor
    """int32 [4], see `STATUS_NEEDED`. Read it late: reading makes the host wait."""


def render_frame(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    deltas: Tensor | None,
    viewmat: Tensor,
    K: Tensor,
    background: Tensor | None,
    width: int,
    height: int,
    capacity: int,
    *,
    eps2d: float = EPS2D,
    near_plane: float = NEAR_PLANE,
    far_plane: float = FAR_PLANE,
    camera_model: str = "pinhole",
    per_tile: bool = False,
    training: bool = False,
) -> Frame:
    """Render N Gaussians, given by their raw parameters, for one camera.

    Args:
        means [N, 3], quats [N, 4] (wxyz, any length but zero), log_scales [N, 3], logit_opacities [N], sh [N, B, 3] with
            B = (degree + 1)², up to degree 4.
        deltas: [N, 16], added to the raw parameters in the layout of `gsplat_core.scene.layout`. Or None.
        viewmat: [4, 4] world to camera, OpenCV axes. K: [3, 3] in pixels, without skew. background: [3], black where None.
        width, height: pixels.
        capacity: for how many instances (a splat in a tile) there is room, in all tiles together or, with `per_tile`, in each.
            Where a frame needs more, `status` says so and how many; its picture is then not to be used. Render again with at
            least as many.
        per_tile: every tile has a room of its own for its list, at most `MOST_IN_TILE`, which saves two passes over the splats
            and takes 8 * tiles * capacity bytes. Not when training.
        eps2d, near_plane, far_plane, camera_model: as in `gsplat_core.rasterization`.
        training: also return what the gradient needs, and the depth as the sum of weight and z.

    Where `sh` is float16 (not when training), the picture is also blended in half precision, on the tensor cores: faster, and
    nearly the same. Colours end at 65,504 there, and splats thinner than a hundredth of a pixel (with `eps2d` 0) are left out.
    Everything else is float32 all the same.

    The picture is that of `gsplat_core.reference.render_frame`. A Gaussian with a value that is not finite, or a rotation of
    length zero, is left out. Nothing waits for the device and all memory is torch's, so a call can be captured in a CUDA graph;
    viewmat, K, background and deltas are read on the device each time. The same inputs give the same bits.

    float32 on CUDA only (but for `sh`): raises InvalidInput for anything else and for wrong shapes.
    """
    n = len(means)
    require_shape("means", means, (n, 3), "[N, 3]")
    require_shape("quats", quats, (n, 4), "[N, 4]")
    require_shape("log_scales", log_scales, (n, 3), "[N, 3]")
    require_shape("logit_opacities", logit_opacities, (n,), "[N]")
    bases = sh.shape[1] if sh.dim() == 3 else 0
    if bases not in [(degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1)] or tuple(sh.shape) != (n, bases, 3):
        raise InvalidInput(
            f"sh must be [N, B, 3] with N = {n} and B = (degree + 1)², degree 0 to {MAX_SH_DEGREE}; got {list(sh.shape)}"
        )
    if deltas is not None:
        require_shape("deltas", deltas, (n, RAW_COLUMNS), "[N, 16]")
    require_shape("viewmat", viewmat, (4, 4), "[4, 4]")
    require_shape("K", K, (3, 3), "[3, 3]")
    if background is not None:
        require_shape("background", background, (3,), "[3]")
    full_sh = None if sh.dtype == torch.float16 and not training else sh
    require_float32(
        "render_frame", means=means, quats=quats, log_scales=log_scales, logit_opacities=logit_opacities, sh=full_sh, deltas=deltas,
        viewmat=viewmat, K=K, background=background,
    )  # fmt: skip
    if width < 1 or height < 1:
        raise InvalidInput(f"the image must be at least 1x1 px, got width={width}, height={height}")
    if capacity < 1:
        raise InvalidInput(f"capacity must be at least 1 instance, got {capacity}")
    if per_tile and training:
        raise InvalidInput("training numbers the instances of all tiles; render the frame with per_tile=False")
    if per_tile and capacity > MOST_IN_TILE:
        raise InvalidInput(
            f"a tile's own room holds at most {MOST_IN_TILE} instances, got {capacity}; use per_tile=False"
        )
    if camera_model not in CAMERA_MODELS:
        raise InvalidInput(f"unknown camera_model {camera_model!r}; the models are {', '.join(CAMERA_MODELS)}")
    if means.device.type != "cuda":
        raise InvalidInput(
            f"render_frame runs on CUDA only and the Gaussians are on {means.device}; gsplat_core.render runs on any device"
        )
    if native.CUDA_MISSING is not None:
        raise InvalidInput(f"render_frame needs the CUDA kernels, which are {native.CUDA_MISSING}")
    return Frame(
        *torch.ops.gsplat_core.render_frame(
            means, quats, log_scales, logit_opacities, sh, deltas, viewmat, K, background, width, height, eps2d, near_plane,
            far_plane, CAMERA_MODELS.index(camera_model), capacity, per_tile, training,
        )
    )  # fmt: skip


@torch.library.register_fake("gsplat_core::render_frame")
def _fake(
    means: Tensor, quats: Tensor, log_scales: Tensor, logit_opacities: Tensor, sh: Tensor, deltas: Tensor | None,
    viewmat: Tensor, K: Tensor, background: Tensor | None, width: int, height: int, eps2d: float, near_plane: float,
    far_plane: float, camera_model: int, capacity: int, per_tile: bool, training: bool,
) -> tuple[Tensor, ...]:  # fmt: skip
    n = means.shape[0]
    tiles = math.ceil(width / TILE_SIZE) * math.ceil(height / TILE_SIZE)

    def ints(*shape: int) -> Tensor:
        return means.new_empty(shape, dtype=torch.int32)

    return (
        means.new_empty((height, width, 4)),
        means.new_empty((height, width)),
        ints(height, width) if training else ints(0, 0),
        means.new_empty((n, 12)),
        ints(0 if per_tile else tiles + 1),
        ints(capacity if training else 0),
        ints(n + 1 if training else 0),
        ints(capacity if training else 0),
        ints(4),
    )
