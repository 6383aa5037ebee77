"""Alpha compositing by the 3D response of Gaussians along each pixel's ray (3DGUT, Wu et al. 2025), with gradients."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_same_kind, require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.unscented_projection.parameters import UnscentedTransformParameters
from gsplat_core.ops.unscented_projection.plain_torch import sigma_offsets
from gsplat_core.ops.unscented_projection.unscented_projection import checked_camera
from gsplat_core.ops.world_blending.plain_torch import blend_world
from gsplat_core.poses.rolling_shutter import RollingShutterType, Shutter
from gsplat_core.scene.distortion import FThetaCameraDistortionParameters, Lens


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
    # Whitening matrices: rows are the axes divided by the scales.
    whitening = sigma_offsets(quats, torch.ones_like(scales)) / scales[..., None]
    blend = blend_world
    if means.dtype == torch.float32:
        # Loaded when it is first needed, so that float64 works without the compiled library.
        from gsplat_core.ops.world_blending.compiled import blend_compiled

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
