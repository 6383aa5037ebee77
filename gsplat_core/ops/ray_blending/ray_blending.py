"""Depth along the rays of a picture, and further channels, blended with the picture's weights; with gradients.

For a ray d with d_z = 1 through the camera, the density of a Gaussian is highest at t = (d' G mu) / (d' G d), where mu is
its centre in camera axes and G the inverse of its covariance (UniGS, Xie et al. 2025). With d = mu / z + J x, where x is
the offset in pixels from the splat's mean, this is

    t(x) = (z + n.x) / (1 + l.x + x' M x),  n = z g,  l = 2 g,  g = J' G d0 / q,  M = J' G J / q,  q = d0' G d0,  d0 = mu / z,

in which no large numbers cancel. `splat_rays` computes these coefficients, `blend_rays` blends t.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.scene.cameras import CameraModel

RAY_NUMBERS = 10
"""Columns of a splat's ray coefficients: z, n (2), l (2), M (xx, twice xy, yy), reach and variance."""
MAX_CHANNELS = 15
"""Maximum number of channels of one call."""
REACH_SIGMAS = 3.0
"""Limit of the ray depth around the depth of the splat's centre, in its largest standard deviations."""
LEAST_SCALE = 1e-5
"""Smallest standard deviation of a splat relative to its largest one; keeps G finite in float32."""


class BlendedRays(NamedTuple):
    """Blended values of every pixel; 0 where no splat is hit."""

    values: Tensor
    """Sums of weight times channel [H, W, D]; not divided by the opacity."""
    alphas: Tensor
    """Accumulated opacity [H, W]."""
    depths: Tensor
    """Mean depth [H, W] along the ray, weighted by the blending weights."""
    medians: Tensor
    """Depth [H, W] of the splat at which transmittance falls to 1/2; 0 if it never does."""
    variances: Tensor
    """Variance of depth [H, W] along the ray, across splats and within their thickness. Has no gradient."""


def splat_rays(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, camera_model: CameraModel
) -> Tensor:
    """Compute the ray coefficients [N, 10] of Gaussians seen by one camera; differentiable.

    Rows of Gaussians behind the camera plane or with values that are not finite are arbitrary and have no gradient. A fisheye
    camera has no linear relation between pixel and ray. Its splats have the depth of their centre everywhere.

    Args:
        means: centres [N, 3] in world units.
        quats: rotations [N, 4] as wxyz.
        scales: standard deviations [N, 3].
        viewmat: world-to-camera matrix [4, 4].
        K: intrinsic matrix [3, 3].
        camera_model: projection of the camera.
    """
    rotation = viewmat[:3, :3]
    local = means @ rotation.T + viewmat[:3, 3]
    with torch.no_grad():
        visible = (local[:, 2] > 0) & torch.cat([local, quats, scales], -1).isfinite().all(-1) & (scales > 0).all(-1)
        visible = visible[:, None]
    x, y, z = torch.where(visible, local, local.new_tensor([0, 0, 1])).unbind(-1)
    quats = torch.where(visible, quats, quats.new_tensor([1, 0, 0, 0]))
    scales = torch.where(visible, scales, 1)
    largest = scales.amax(-1)
    reach = REACH_SIGMAS * largest
    zero = torch.zeros_like(z)
    if camera_model == "fisheye":
        return torch.stack([z, *[zero] * 7, reach, largest * largest], -1)
    w, i, j, k = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    axes = torch.stack(
        [
            *(1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)),
            *(2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)),
            *(2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)),
        ],
        -1,
    ).unflatten(-1, (3, 3))
    # Rows are the axes of camera space; column k is divided by the scale of principal axis k. All coefficients except the
    # variance, which has no gradient, are independent of a common factor of the scales.
    largest = largest.detach()
    relative = (scales / largest[:, None]).clamp(min=LEAST_SCALE)
    whitened = (rotation @ axes) / relative[:, None, :]
    if camera_model == "ortho":
        forward = whitened[:, 2]
        q = (forward * forward).sum(-1)
        slope = -(whitened[:, :2] * forward[:, None]).sum(-1) / q[:, None]
        n = [slope[:, 0] / K[0, 0], slope[:, 1] / K[1, 1]]
        return torch.stack([z, *n, *[zero] * 5, reach, largest * largest / q], -1)
    across, down = whitened[:, 0] / K[0, 0], whitened[:, 1] / K[1, 1]
    forward = whitened[:, 0] * (x / z)[:, None] + whitened[:, 1] * (y / z)[:, None] + whitened[:, 2]
    q = (forward * forward).sum(-1)
    gx, gy = (across * forward).sum(-1) / q, (down * forward).sum(-1) / q
    xx, xy, yy = (across * across).sum(-1) / q, (across * down).sum(-1) / q, (down * down).sum(-1) / q
    return torch.stack([z, z * gx, z * gy, 2 * gx, 2 * gy, xx, 2 * xy, yy, reach, largest * largest / q], -1)


def blend_rays(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    values: Tensor,
    image_width: int,
    image_height: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    *,
    max_alpha: float = 0.99,
) -> BlendedRays:
    """Blend ray depths and channels of one image front to back with the weights of `rasterize_to_pixels`.

    Splats with a non-finite value are skipped and have no gradient. The result does not depend on the number of threads.

    Args:
        means2d: means [N, 2] in pixels.
        conics: upper triangles [N, 3] of the inverse covariances, 1/pixels².
        opacities: opacities [N] in 0..1.
        rays: ray coefficients [N, 10] from `splat_rays`.
        values: further channels [N, D] to blend, D from 0 to `MAX_CHANNELS`.
        image_width: width in pixels.
        image_height: height in pixels.
        isect_offsets: int32 [tile_height, tile_width] for tiles of 16 pixels.
        flatten_ids: int32 [M].
        max_alpha: upper limit of alpha, from 1/255 to below 1.

    Raises:
        InvalidInput: for wrong shapes, dtypes or limits.
    """
    count = opacities.shape[0] if opacities.ndim == 1 else -1
    expected = {"means2d": (count, 2), "conics": (count, 3), "opacities": (count,), "rays": (count, RAY_NUMBERS)}
    given = {"means2d": means2d, "conics": conics, "opacities": opacities, "rays": rays}
    for name, shape in expected.items():
        if tuple(given[name].shape) != shape:
            raise InvalidInput(f"{name} must have shape {['N', *shape[1:]]} with one N, got {list(given[name].shape)}")
    if values.ndim != 2 or values.shape[0] != count or values.shape[1] > MAX_CHANNELS:
        raise InvalidInput(f"values must be [{count}, D] with D up to {MAX_CHANNELS}, got {list(values.shape)}")
    for name, tensor in {**given, "values": values}.items():
        if tensor.dtype != torch.float32:
            raise InvalidInput(f"{name} must be float32, got {tensor.dtype}; gsplat_core.reference takes any dtype")
    for name, tensor in {"isect_offsets": isect_offsets, "flatten_ids": flatten_ids}.items():
        if tensor.dtype != torch.int32:
            raise InvalidInput(f"{name} must be int32 as bin_splats returns it, got {tensor.dtype}")
    if isect_offsets.ndim != 2 or flatten_ids.ndim != 1:
        raise InvalidInput(
            "isect_offsets must be [tile_height, tile_width] and flatten_ids [M], got"
            f" {list(isect_offsets.shape)} and {list(flatten_ids.shape)}"
        )
    if isect_offsets.shape[0] * 16 < image_height or isect_offsets.shape[1] * 16 < image_width:
        raise InvalidInput(
            f"{list(isect_offsets.shape)} tiles of 16 px do not cover the image of {image_width} x {image_height} px"
        )
    if not 1 / 255 <= max_alpha < 1:
        raise InvalidInput(f"max_alpha must be from 1/255 to below 1, got {max_alpha}")
    blended = torch.ops.gsplat_core.blend_rays(
        means2d, conics, opacities, rays, values, isect_offsets, flatten_ids, image_width, image_height, max_alpha
    )
    return BlendedRays(*blended[:5])


@torch.library.register_fake("gsplat_core::blend_rays")
def _blend_rays_fake(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rays: Tensor,
    values: Tensor,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    width: int,
    height: int,
    *limit: float,
) -> tuple[Tensor, ...]:
    plane = lambda: values.new_empty(height, width)
    index = lambda: isect_offsets.new_empty(height, width)
    return values.new_empty(height, width, values.shape[1]), plane(), plane(), plane(), plane(), index(), index()


@torch.library.register_fake("gsplat_core::blend_rays_backward")
def _blend_rays_backward_fake(
    means2d: Tensor, conics: Tensor, opacities: Tensor, rays: Tensor, values: Tensor, *rest: Any
) -> tuple[Tensor, ...]:
    count, channels = values.shape
    shapes = ((count, 2), (count, 3), (count,), (count, RAY_NUMBERS), (count, channels))
    return tuple(values.new_empty(shape) for shape in shapes)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, width, height, max_alpha = inputs
    _, alphas, depths, _, variances, last, median_at = output
    ctx.mark_non_differentiable(variances, last, median_at)
    ctx.save_for_backward(*tensors, alphas, depths, last, median_at)
    ctx.sizes, ctx.max_alpha = (width, height), max_alpha


def _backward(
    ctx: Any, v_values: Tensor, v_alphas: Tensor, v_depths: Tensor, v_medians: Tensor, *_: Tensor | None
) -> tuple[Tensor | None, ...]:
    *tensors, alphas, depths, last, median_at = ctx.saved_tensors
    gradients = torch.ops.gsplat_core.blend_rays_backward(
        *tensors, *ctx.sizes, alphas, depths, last, median_at, v_values, v_alphas, v_depths, v_medians, ctx.max_alpha
    )
    return (*gradients, None, None, None, None, None)


torch.library.register_autograd("gsplat_core::blend_rays", _backward, setup_context=_setup_context)
