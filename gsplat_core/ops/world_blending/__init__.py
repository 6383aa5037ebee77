"""Alpha compositing by the 3D response of Gaussians along each pixel's ray (3DGUT, Wu et al. 2025), with gradients.

Compiled kernels run where they apply. The implementation in plain torch supports any floating dtype and device, and is
the reference for tests of the kernels.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_kernels, require_same_kind, require_shape
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.native import register_gradient
from gsplat_core.ops.unscented_projection import UnscentedTransformParameters, checked_camera, sigma_offsets
from gsplat_core.poses.se3 import RollingShutterType, Shutter
from gsplat_core.scene.distortion import FThetaCameraDistortionParameters, Lens


def blend_compiled(
    means: Tensor,
    whitening: Tensor,
    colors: Tensor,
    opacities: Tensor,
    rays: Tensor,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    masks: Tensor | None,
    max_alpha: float,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians by the compiled kernels, with the result of `blend_world` in plain torch.

    On the CPU, tile lists with indices out of range raise an error.
    """
    require_kernels("rasterize_to_pixels_eval3d", "means", means)
    gaussians = torch.cat([means, whitening.flatten(-2)], -1)
    # A weight of 0 times a colour that is not finite would not be 0.
    usable = (colors * 0).sum(-1) + opacities * 0 == 0
    image, through, _ = torch.ops.gsplat_core.blend_world(
        gaussians,
        colors,
        torch.where(usable, opacities, 0),
        rays,
        isect_offsets,
        flatten_ids,
        masks,
        tile_size,
        max_alpha,
    )
    return image, through


@torch.library.register_fake("gsplat_core::blend_world")
def _fake(
    gaussians: Tensor, colors: Tensor, opacities: Tensor, rays: Tensor, isect_offsets: Tensor, *rest: Any
) -> tuple[Tensor, Tensor, Tensor]:
    size = rays.shape[:3]
    return colors.new_empty(*size, colors.shape[-1]), colors.new_empty(*size, 1), isect_offsets.new_empty(size)


@torch.library.register_fake("gsplat_core::blend_world_backward")
def _backward_fake(
    gaussians: Tensor, colors: Tensor, opacities: Tensor, rays: Tensor, *rest: Any
) -> tuple[Tensor, ...]:
    of_gaussians = colors.new_empty(*opacities.shape, gaussians.shape[-1])
    return of_gaussians, torch.empty_like(colors), torch.empty_like(opacities), torch.empty_like(rays)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, ctx.tile_size, ctx.max_alpha = inputs
    _, through, last = output
    ctx.mark_non_differentiable(last)
    ctx.save_for_backward(*tensors, through, last)


def _backward(ctx: Any, v_image: Tensor, v_through: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
    *tensors, through, last = ctx.saved_tensors
    v_gaussians, v_colors, v_opacities, v_rays = torch.ops.gsplat_core.blend_world_backward(
        *tensors, ctx.tile_size, ctx.max_alpha, through, last, v_image, v_through
    )
    batches, images = tensors[0].shape[0], v_gaussians.shape[0]
    cameras = images // batches if batches else 0
    of_batches = v_gaussians.reshape(batches, cameras, *v_gaussians.shape[1:]).sum(1)
    return of_batches, v_colors, v_opacities, v_rays, None, None, None, None, None


register_gradient("gsplat_core::blend_world", _backward, setup_context=_setup_context)


ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_STOP = 1e-4
PAIRS_AT_A_TIME = 1 << 21
"""Largest number of pairs of pixel and splat that are evaluated at once, which bounds memory."""


def blend_world(
    means: Tensor,
    whitening: Tensor,
    colors: Tensor,
    opacities: Tensor,
    rays: Tensor,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    masks: Tensor | None,
    max_alpha: float,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians front to back by their largest response along each ray; see `rasterize_to_pixels_eval3d`.

    Args:
        means: centres [B, N, 3].
        whitening: matrices [B, N, 3, 3] that map offsets from the centre to standard deviations.
        colors: [I, N, D] with I = B C images.
        opacities: [I, N].
        rays: origin and direction [I, H, W, 6]; NaN where the lens sees nothing.
        tile_size: side of a tile in pixels.
        isect_offsets: int32 [I, tile_height, tile_width].
        flatten_ids: int32 [M], indices into [I, N].
        masks: bool [I, tile_height, tile_width], or None.
        max_alpha: upper limit of alpha.

    Returns:
        Colours [I, H, W, D] without background, and remaining transmittance [I, H, W, 1].
    """
    images, height, width = rays.shape[:3]
    tile_height, tile_width = isect_offsets.shape[-2:]
    count, channels = colors.shape[-2:]
    with torch.no_grad():
        starts = torch.cat([isect_offsets.reshape(-1), isect_offsets.new_full((1,), flatten_ids.numel())]).long()
        sizes = starts.diff()
        if masks is not None:
            sizes = sizes * masks.reshape(-1)
        order = torch.argsort(sizes, stable=True)
        lengths = sizes[order].tolist()
    # Arrange the rays by tile: [tiles, pixels of a tile, 6].
    bottom, right = tile_height * tile_size - height, tile_width * tile_size - width
    tiled = torch.nn.functional.pad(rays, (0, 0, 0, right, 0, bottom), value=float("nan"))
    tiled = tiled.reshape(images, tile_height, tile_size, tile_width, tile_size, 6).transpose(2, 3)
    tiled = tiled.reshape(-1, tile_size * tile_size, 6)
    splats = torch.cat(
        [
            means.reshape(-1, 3),
            whitening.reshape(-1, 9),
        ],
        -1,
    )
    shown = torch.cat([opacities.reshape(-1, 1), colors.reshape(-1, channels)], -1)
    parts, first = [], 0
    while first < len(lengths):
        # Tiles are sorted by the length of their lists, so the last tile of a part decides how much memory the part
        # needs.
        last = first + 1
        while last < len(lengths) and (last + 1 - first) * tile_size**2 * lengths[last] <= PAIRS_AT_A_TIME:
            last += 1
        tiles, longest = order[first:last], lengths[last - 1]
        places = torch.arange(longest, device=rays.device)
        listed = places < sizes[tiles][:, None]
        ids = flatten_ids.long()[torch.where(listed, starts[tiles][:, None] + places, 0)] if longest else listed.long()
        arguments = (
            splats,
            shown,
            tiled[tiles],
            ids,
            listed,
            count * (images // max(means.shape[0], 1)),
            count,
            max_alpha,
        )
        if torch.is_grad_enabled() and any(each.requires_grad for each in (splats, shown, rays)):
            parts.append(checkpoint(_blend_tiles, *arguments, use_reentrant=False))
        else:
            parts.append(_blend_tiles(*arguments))
        first = last
    blended = torch.cat(parts) if parts else rays.new_zeros(0, tile_size * tile_size, channels + 1)
    blended = blended[torch.argsort(order)]
    blended = blended.reshape(images, tile_height, tile_width, tile_size, tile_size, channels + 1).transpose(2, 3)
    blended = blended.reshape(images, tile_height * tile_size, tile_width * tile_size, channels + 1)
    blended = blended[:, :height, :width]
    return blended[..., :channels], blended[..., channels:]


def _blend_tiles(
    splats: Tensor,
    shown: Tensor,
    rays: Tensor,
    ids: Tensor,
    listed: Tensor,
    rows_per_batch: int,
    count: int,
    max_alpha: float,
) -> Tensor:
    """Return colours and transmittance [T, P, D + 1] of T tiles with rays [T, P, 6] and lists [T, L] of splats."""
    if ids.shape[1] == 0:
        return torch.cat([rays.new_zeros(*rays.shape[:2], shown.shape[1] - 1), rays.new_ones(*rays.shape[:2], 1)], -1)
    geometry = splats[torch.div(ids, rows_per_batch, rounding_mode="floor") * count + ids % count]
    values = shown[ids]
    with torch.no_grad():
        usable = listed & geometry.isfinite().all(-1) & values.isfinite().all(-1)
        seen = rays.isfinite().all(-1)
    geometry = torch.where(usable[..., None], geometry, torch.zeros_like(geometry))
    values = torch.where(usable[..., None], values, torch.zeros_like(values))
    rays = torch.where(seen[..., None], rays, torch.ones_like(rays))
    centers, whitening = geometry[..., :3], geometry[..., 3:].unflatten(-1, (3, 3))
    offsets = rays[:, :, None, :3] - centers[:, None]
    origins = torch.einsum("tlij,tplj->tpli", whitening, offsets)
    directions = torch.einsum("tlij,tpj->tpli", whitening, rays[..., 3:])
    squared = (directions * directions).sum(-1, keepdim=True)
    # Offset of the ray's closest point from the centre, in standard deviations.
    nearest = origins - directions * (origins * directions).sum(-1, keepdim=True) / torch.where(squared > 0, squared, 1)
    alphas = values[:, None, :, 0] * torch.exp(-0.5 * (nearest * nearest).sum(-1))
    with torch.no_grad():
        hit = usable[:, None] & seen[..., None] & (alphas >= ALPHA_MIN)
    alphas = torch.where(hit, alphas.clamp(max=max_alpha), torch.zeros_like(alphas))
    product = torch.cumprod(1 - alphas, -1)
    with torch.no_grad():
        # The transmittance only falls, so this keeps a terminated pixel closed.
        still_open = product > TRANSMITTANCE_STOP
    alphas = torch.where(still_open, alphas, torch.zeros_like(alphas))
    through = torch.cumprod(1 - alphas, -1)
    before = torch.cat([torch.ones_like(through[..., :1]), through[..., :-1]], -1)
    blended = torch.einsum("tpl,tld->tpd", alphas * before, values[..., 1:])
    return torch.cat([blended, through[..., -1:]], -1)


@in_plain_mode
def rasterize_to_pixels_eval3d(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    colors: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    camera_model: str = "pinhole",
    ut_params: UnscentedTransformParameters | None = None,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: FThetaCameraDistortionParameters | None = None,
    rolling_shutter: RollingShutterType | None = RollingShutterType.GLOBAL,
    viewmats_rs: Tensor | None = None,
    *,
    max_alpha: float = 0.99,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians front to back by their largest response along each pixel's ray; names as in gsplat 1.5.3.

    alpha = min(max_alpha, opacity exp(-d²/2)), where d is the distance in standard deviations at which the ray passes the
    centre. Other rules are those of `rasterize_to_pixels`. Differentiable in all floating-point tensors, cameras and
    coefficients included. Compiled kernels blend float32 values, plain torch other dtypes. A pixel that the lens does not
    see shows the background.

    Args:
        means: [..., N, 3].
        quats: [..., N, 4] wxyz.
        scales: [..., N, 3].
        colors: [..., C, N, D], any D.
        opacities: [..., C, N].
        viewmats: [..., C, 4, 4].
        Ks: [..., C, 3, 3].
        image_width: width in pixels.
        image_height: height in pixels.
        tile_size: side of a tile in pixels.
        isect_offsets: int32 [..., C, tile_height, tile_width].
        flatten_ids: int32 [M], indices into the flattened [..., C, N].
        backgrounds: [..., C, D].
        masks: bool [..., C, tile_height, tile_width]; a tile with False shows only the background.
        ut_params: accepted for compatibility with gsplat; without effect.
        camera_model, radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs: as
            in `fully_fused_projection_with_ut`.
        max_alpha: upper limit of alpha; 0.99 in gsplat 1.6, 0.999 in 1.5.3.

    Returns:
        Colours [..., C, H, W, D] and alphas [..., C, H, W, 1].

    Raises:
        InvalidInput: for wrong shapes, dtypes or limits.
    """
    if means.dim() < 2 or viewmats.dim() < 3:
        raise InvalidInput(
            f"means must be [..., N, 3] and viewmats [..., C, 4, 4], got {list(means.shape)}, {list(viewmats.shape)}"
        )
    batch_dims, n, c = tuple(means.shape[:-2]), means.shape[-2], viewmats.shape[-3]
    image_dims, channels = (*batch_dims, c), colors.shape[-1] if colors.dim() else 0
    for name, tensor, shape, form in (
        ("means", means, (*batch_dims, n, 3), "[..., N, 3]"),
        ("quats", quats, (*batch_dims, n, 4), "[..., N, 4]"),
        ("scales", scales, (*batch_dims, n, 3), "[..., N, 3]"),
        ("colors", colors, (*image_dims, n, channels), "[..., C, N, D]"),
        ("opacities", opacities, (*image_dims, n), "[..., C, N]"),
        ("viewmats", viewmats, (*image_dims, 4, 4), "[..., C, 4, 4]"),
        ("Ks", Ks, (*image_dims, 3, 3), "[..., C, 3, 3]"),
        ("backgrounds", backgrounds, (*image_dims, channels), "[..., C, D]"),
    ):
        if tensor is not None:
            require_shape(name, tensor, shape, form)
    require_same_kind(
        means=means, quats=quats, scales=scales, colors=colors, opacities=opacities, viewmats=viewmats, Ks=Ks,
        backgrounds=backgrounds,
    )  # fmt: skip
    tiles = (-(-image_height // tile_size), -(-image_width // tile_size)) if tile_size > 0 else (0, 0)
    if (
        tuple(isect_offsets.shape[:-2]) != image_dims
        or isect_offsets.shape[-2] < tiles[0]
        or isect_offsets.shape[-1] < tiles[1]
        or tile_size < 1
    ):
        raise InvalidInput(
            f"isect_offsets must be [..., C, tile_height, tile_width] and cover the image of {image_width} x {image_height} px"
            f" with tiles of {tile_size} px, got {list(isect_offsets.shape)}"
        )
    for name, index in (("isect_offsets", isect_offsets), ("flatten_ids", flatten_ids)):
        if index.dtype != torch.int32:
            raise InvalidInput(
                f"{name} must be int32 as isect_tiles and isect_offset_encode return it, got {index.dtype}"
            )
    if masks is not None and (masks.shape != isect_offsets.shape or masks.dtype != torch.bool):
        raise InvalidInput(f"masks must be bool {list(isect_offsets.shape)}, got {masks.dtype} {list(masks.shape)}")
    if not 1 / 255 <= max_alpha < 1:
        raise InvalidInput(f"max_alpha must be from 1/255 to below 1, got {max_alpha}")
    lens, shutter = checked_camera(
        image_dims, viewmats, Ks, camera_model, radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs,
        rolling_shutter, viewmats_rs,
    )  # fmt: skip
    rays = pixel_rays(lens, shutter, Ks, image_width, image_height)
    batches, images = math.prod(batch_dims), math.prod(image_dims)
    # Gaussians without a whitening matrix show nothing, and get no gradient from its infinite elements.
    usable = quats.isfinite().all(-1) & (quats != 0).any(-1)
    usable &= scales.isfinite().all(-1) & (1 / (scales * scales)).isfinite().all(-1)
    identity = torch.tensor([1.0, 0, 0, 0], dtype=quats.dtype, device=quats.device)
    quats = torch.where(usable[..., None], quats, identity)
    scales = torch.where(usable[..., None], scales, torch.ones_like(scales))
    opacities = torch.where(usable[..., None, :], opacities, torch.zeros_like(opacities))
    # Whitening matrices: rows are the axes divided by the scales.
    whitening = sigma_offsets(quats, torch.ones_like(scales)) / scales[..., None]
    blend = blend_world
    if means.dtype == torch.float32:
        blend = blend_compiled
    image, through = blend(
        means.reshape(batches, n, 3), whitening.reshape(batches, n, 3, 3), colors.reshape(images, n, channels),
        opacities.reshape(images, n), rays.reshape(images, image_height, image_width, 6), tile_size,
        isect_offsets.reshape(images, *isect_offsets.shape[-2:]), flatten_ids,
        None if masks is None else masks.reshape(images, *masks.shape[-2:]), max_alpha,
    )  # fmt: skip
    if backgrounds is not None:
        image = image + through * backgrounds.reshape(images, 1, 1, channels)
    shape = (*image_dims, image_height, image_width)
    return image.reshape(*shape, channels), (1 - through).reshape(*shape, 1)


def pixel_rays(lens: Lens, shutter: Shutter, Ks: Tensor, width: int, height: int) -> Tensor:
    """Return origin and unit direction [..., C, H, W, 6] of the pixels' rays in world axes; NaN where the lens sees nothing."""
    x = torch.arange(width, device=Ks.device, dtype=Ks.dtype) + 0.5
    y = torch.arange(height, device=Ks.device, dtype=Ks.dtype) + 0.5
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    pixels = pixels.expand(*Ks.shape[:-2], -1, 2)
    origins, directions, valid = lens.rays(pixels, Ks)
    directions, origins = shutter.to_world(directions, origins, shutter.times(pixels, width, height))
    rays = torch.cat([origins.expand_as(directions), directions], -1)
    rays = torch.where(valid[..., None], rays, torch.full_like(rays, float("nan")))
    return rays.unflatten(-2, (height, width))
