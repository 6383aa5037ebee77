"""Optical flow blended from splats that carry surface points from one camera to another by affine maps, with gradients of the
maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_tiled_splats
from gsplat_core.ops.native import register_gradient
from gsplat_core.ops.splat_rays import RAY_NUMBERS
from gsplat_core.scene.cameras import Camera

PLANE_NUMBERS = 12
"""Number of values of a splat's map p -> a + B p from the first camera's axes to those of the second: a, then the rows of B."""


def blend_flow(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    planes: Tensor,
    before: Camera,
    after: Camera,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> Tensor:
    """Blend the flow of N splats front to back over every pixel of the first camera.

    The ray of pixel x is t d with d = K1⁻¹ (x, 1). Splat i shows the point at t_i = (z + n·δ) / (1 + l·δ + δᵀ M δ) with δ
    the offset of x from the splat's mean, limited to z ± reach; z, n, l, M and reach are its ray coefficients `rays`. The
    splat carries the point to p = a + t_i B d in the axes of the second camera, so its flow is K2 p / p_z - x. Weights are
    those of `rasterize_to_pixels`. Only `planes` has a gradient. Splats with a non-finite value are skipped, and so are
    points behind the second camera. The result does not depend on the number of threads.

    Args:
        means2d: float32 [N, 2] pixels of the first camera.
        conics: float32 [N, 3], upper triangle of the inverse covariance, 1/pixels².
        opacities: float32 [N] in 0..1.
        rays: float32 [N, 10] of the first camera, from `splat_rays`.
        planes: float32 [N, 12] from the first camera's axes to those of the second, see `PLANE_NUMBERS`.
        before: pinhole camera of the splats and of the result.
        after: pinhole camera in which points arrive; its size is not used.
        isect_offsets: int32 [tile_height, tile_width] for tiles of 16 pixels, from `bin_splats`.
        flatten_ids: int32 [M], from `bin_splats`.

    Returns:
        float32 [H, W, 4]: sums over splats of w flow x, w flow y and w p_z, and of the weights w.

    Raises:
        InvalidInput: for wrong shapes, dtypes or camera models.
    """
    require_tiled_splats(
        "blend_flow", (before.width_px, before.height_px), isect_offsets, flatten_ids, opacities,
        means2d=(means2d, 2), conics=(conics, 3), rays=(rays, RAY_NUMBERS), planes=(planes, PLANE_NUMBERS),
    )  # fmt: skip
    for camera in (before, after):
        if camera.model != "pinhole":
            raise InvalidInput(f"blend_flow takes pinhole cameras, got {camera.model!r}")
    size = before.width_px, before.height_px
    return torch.ops.gsplat_core.blend_flow(
        means2d, conics, opacities, rays, planes, isect_offsets, flatten_ids, intrinsics_of(before, after), *size
    )


def intrinsics_of(before: Camera, after: Camera) -> Sequence[float]:
    """Return fx, fy, cx, cy of both cameras."""
    return [float(camera.K[at]) for camera in (before, after) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]


@torch.library.register_fake("gsplat_core::blend_flow")
def _fake(means2d: Tensor, *rest: Any) -> Tensor:
    width, height = rest[-2:]
    return means2d.new_empty(height, width, 4)


@torch.library.register_fake("gsplat_core::blend_flow_backward")
def _backward_fake(means2d: Tensor, conics: Tensor, opacities: Tensor, rays: Tensor, planes: Tensor, *_: Any) -> Tensor:
    return planes.new_empty(planes.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:7])
    ctx.rest = inputs[7:]


def _backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:
    v_planes = torch.ops.gsplat_core.blend_flow_backward(*ctx.saved_tensors, *ctx.rest, v_out)
    return (None, None, None, None, v_planes, None, None, None, None, None)


register_gradient("gsplat_core::blend_flow", _backward, setup_context=_setup_context)
