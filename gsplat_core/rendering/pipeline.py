"""The way from Gaussians to images, for any implementation of the operations it is built from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_same_kind, require_shape
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.projection.arguments import DenseProjection, PackedProjection, pack
from gsplat_core.rendering.meta import Deferred, Meta
from gsplat_core.rendering.settings import (
    EPS2D,
    FAR_PLANE,
    NEAR_PLANE,
    TILE_SIZE,
    RasterizeMode,
    RenderMode,
    RenderSettings,
    refuse_unsupported,
)
from gsplat_core.rendering.view_colors import view_colors

Rasterized = tuple[Tensor, Tensor, Meta]
"""Colours [..., C, H, W, X], alphas [..., C, H, W, 1] and what was computed on the way."""


@dataclass(frozen=True)
class Operations:
    """One implementation of the operations, under gsplat's names and signatures, and `rasterization` built from them."""

    fully_fused_projection: Callable[..., Any]
    spherical_harmonics: Callable[..., Tensor]
    isect_tiles: Callable[..., tuple[Tensor, Tensor, Tensor]]
    bin_splats: Callable[..., tuple[Tensor, Tensor, Tensor]]
    rasterize_to_pixels: Callable[..., tuple[Tensor, Tensor]]
    passes_no_zeros_on: bool = False
    """On CUDA a gradient of zero stays zero in the backward operations, whatever it would be multiplied with."""

    def rasterization(
        self,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        opacities: Tensor,
        colors: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        near_plane: float = NEAR_PLANE,
        far_plane: float = FAR_PLANE,
        radius_clip: float = 0.0,
        eps2d: float = EPS2D,
        sh_degree: int | None = None,
        *,
        packed: bool = True,
        tile_size: int | None = TILE_SIZE,
        backgrounds: Tensor | None = None,
        render_mode: RenderMode = "RGB",
        sparse_grad: bool = False,
        absgrad: bool = False,
        rasterize_mode: RasterizeMode = "classic",
        channel_chunk: int = 32,
        distributed: bool = False,
        camera_model: str = "pinhole",
        segmented: bool = False,
        covars: Tensor | None = None,
        with_ut: bool = False,
        with_eval3d: bool = False,
        radial_coeffs: Tensor | None = None,
        tangential_coeffs: Tensor | None = None,
        thin_prism_coeffs: Tensor | None = None,
        ftheta_coeffs: Any = None,
        rolling_shutter: Any = None,
        viewmats_rs: Tensor | None = None,
    ) -> Rasterized:
        """Render 3D Gaussians (Kerbl et al. 2023) with gsplat 1.5.3's arguments and results.

        Shapes; `...` are any batch dimensions, the same everywhere:
            means [..., N, 3]; quats [..., N, 4] wxyz, of any length but zero; scales [..., N, 3]; opacities [..., N];
            colors [..., N, D] or [..., C, N, D] when `sh_degree` is None, else coefficients [..., N, K, 3] or
            [..., C, N, K, 3] with K >= (sh_degree + 1)², shown as max(0, 0.5 + sum);
            viewmats [..., C, 4, 4] world to camera, OpenCV axes; Ks [..., C, 3, 3] in pixels.

        Args:
            width, height: image size in pixels; the first pixel's centre is at (0.5, 0.5).
            near_plane, far_plane: Gaussians whose centre has a z outside of these are culled.
            radius_clip: Gaussians with both radii at or below this many pixels are culled.
            eps2d: blur in pixels² added to the diagonal of the 2D covariance.
            packed: `meta` holds one row per visible Gaussian and camera; the image is the same.
            tile_size: side of the square tiles in pixels; None = 16.
            backgrounds: [..., C, D], blended behind the colours; the depth channel has background 0.
            render_mode: "RGB", "D" (depth z, weighted by alpha), "ED" (divided by alpha), "RGB+D" or "RGB+ED"
                (depth is the last channel).
            absgrad: after backward, `meta["means2d"].absgrad` holds the sum of absolute gradients (Ye et al. 2024).
            rasterize_mode: "antialiased" scales the opacity by sqrt(det Σ / det (Σ + blur)) (Yu et al. 2024).
            camera_model: "pinhole", "ortho" or "fisheye" (equidistant).
            covars: [..., N, 3, 3] in place of quats and scales.
            channel_chunk, segmented: accepted and without effect; neither changes the result.

        Returns:
            render_colors [..., C, H, W, X], render_alphas [..., C, H, W, 1] and `meta` with batch_ids, camera_ids and
            gaussian_ids (None unless packed), radii, means2d (call retain_grad() on it to see its gradient), depths,
            conics, opacities, tile_width, tile_height, tiles_per_gauss, isect_ids, flatten_ids, isect_offsets, width,
            height, tile_size, n_batches and n_cameras.

        A Gaussian with a NaN or an infinity in any input, or a rotation of length zero, is culled: it has radii 0, gets
        zero gradients and does not touch the others.

        Raises:
            InvalidInput: a shape, dtype, device or mode that does not fit, with what was seen.
            NotImplementedError: an argument of gsplat's that is not supported, with its value.
        """
        refuse_unsupported(
            sparse_grad=sparse_grad, distributed=distributed, with_ut=with_ut, with_eval3d=with_eval3d,
            radial_coeffs=radial_coeffs, tangential_coeffs=tangential_coeffs, thin_prism_coeffs=thin_prism_coeffs,
            ftheta_coeffs=ftheta_coeffs, rolling_shutter=rolling_shutter, viewmats_rs=viewmats_rs,
        )  # fmt: skip
        settings = RenderSettings(
            width=width, height=height, near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d,
            sh_degree=sh_degree, packed=packed, tile_size=TILE_SIZE if tile_size is None else tile_size,
            render_mode=render_mode, absgrad=absgrad, rasterize_mode=rasterize_mode, camera_model=camera_model,
        )  # fmt: skip
        return _rasterize(self, means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars, settings)


def _rasterize(
    ops: Operations,
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    backgrounds: Tensor | None,
    covars: Tensor | None,
    settings: RenderSettings,
) -> Rasterized:
    """Project, colour, sort and blend; shapes and errors as in `Operations.rasterization`."""
    width, height = settings.width, settings.height
    batch_dims, n_cameras, n_gaussians = _check_shapes(means, opacities, colors, viewmats, backgrounds, settings)
    if covars is not None:
        require_shape("covars", covars, (*batch_dims, n_gaussians, 3, 3), "[..., N, 3, 3]")
        # Not by an index of lists: on CUDA the host would wait until they are on the device.
        covars = torch.stack([covars[..., i, j] for i in range(3) for j in range(i, 3)], -1)
        quats = scales = None
    dense: DenseProjection = ops.fully_fused_projection(
        means, covars, quats, scales, viewmats, Ks, width, height,
        eps2d=settings.eps2d, near_plane=settings.near_plane, far_plane=settings.far_plane,
        radius_clip=settings.radius_clip, calc_compensations=settings.rasterize_mode == "antialiased",
        camera_model=settings.camera_model, opacities=opacities,
    )  # fmt: skip
    channels = None
    if settings.has_colors:
        channels, dense = view_colors(ops, means, colors, viewmats, dense, settings)
    opacities = opacities[..., None, :].expand(*batch_dims, n_cameras, n_gaussians)

    rows: DenseProjection | PackedProjection = dense
    ids: dict[str, Tensor | None] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    tiling: dict[str, Any] = {}
    if settings.packed:
        rows = pack(dense)
        ids = {name: getattr(rows, name) for name in ids}
        image_ids = rows.batch_ids * n_cameras + rows.camera_ids
        n_images = math.prod(batch_dims) * n_cameras
        tiling = {"packed": True, "n_images": n_images, "image_ids": image_ids}
        picked = image_ids * n_gaussians + rows.gaussian_ids
        opacities = opacities.reshape(-1)[picked]
        channels = None if channels is None else channels.reshape(-1, channels.shape[-1])[picked]
    if rows.compensations is not None:
        opacities = opacities * rows.compensations
    if settings.has_depth:
        depth = rows.depths[..., None]
        channels = depth if channels is None else torch.cat([channels, depth], -1)
        if backgrounds is not None:
            zeros = backgrounds.new_zeros(*backgrounds.shape[:-1], 1)
            backgrounds = torch.cat([backgrounds, zeros], -1) if settings.has_colors else zeros
    assert channels is not None

    tile_size = settings.tile_size
    tile_width, tile_height = -(-width // tile_size), -(-height // tile_size)
    grid = (tile_size, tile_width, tile_height)
    splats = (rows.means2d, rows.radii, rows.depths)
    exact = {"conics": rows.conics, "opacities": opacities}
    tiles_per_gauss, flatten_ids, isect_offsets = ops.bin_splats(*splats, *grid, **exact, **tiling)
    isect_offsets = isect_offsets.reshape(*batch_dims, n_cameras, tile_height, tile_width)
    render_colors, render_alphas = ops.rasterize_to_pixels(
        rows.means2d, rows.conics, channels, opacities, width, height, tile_size, isect_offsets, flatten_ids,
        backgrounds=backgrounds, packed=settings.packed, absgrad=settings.absgrad,
    )  # fmt: skip
    if settings.render_mode.endswith("ED"):
        expected = render_colors[..., -1:] / render_alphas.clamp(min=1e-10)
        render_colors = torch.cat([render_colors[..., :-1], expected], -1) if settings.has_colors else expected
    meta = Meta(
        **ids,
        radii=rows.radii,
        means2d=rows.means2d,
        depths=rows.depths,
        conics=rows.conics,
        opacities=opacities,
        tile_width=tile_width,
        tile_height=tile_height,
        tiles_per_gauss=tiles_per_gauss,
        isect_ids=Deferred(lambda: ops.isect_tiles(*splats, *grid, **exact, **tiling)[1]),
        flatten_ids=flatten_ids,
        isect_offsets=isect_offsets,
        width=width,
        height=height,
        tile_size=tile_size,
        n_batches=math.prod(batch_dims),
        n_cameras=n_cameras,
    )
    return render_colors, render_alphas, meta


def _check_shapes(
    means: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    backgrounds: Tensor | None,
    settings: RenderSettings,
) -> tuple[tuple[int, ...], int, int]:
    """Batch dimensions, cameras and Gaussians; what the projection checks is left to it."""
    if means.dim() < 2 or means.shape[-1] != 3:
        raise InvalidInput(f"means must be [..., N, 3], got {list(means.shape)}")
    if viewmats.dim() < 3:
        raise InvalidInput(f"viewmats must be [..., C, 4, 4], got {list(viewmats.shape)}")
    batch_dims, n, c = tuple(means.shape[:-2]), means.shape[-2], viewmats.shape[-3]
    require_shape("opacities", opacities, (*batch_dims, n), "[..., N]")
    trailing = 1 if settings.sh_degree is None else 2
    form = "[..., (C,) N, D]" if settings.sh_degree is None else "[..., (C,) N, K, 3]"
    leading = tuple(colors.shape[: colors.dim() - trailing])
    if leading not in ((*batch_dims, n), (*batch_dims, c, n)):
        raise InvalidInput(f"colors must be {form} with N = {n}, C = {c}, got {list(colors.shape)}")
    if settings.sh_degree is None and settings.has_colors and colors.shape[-1] < 1:
        raise InvalidInput(f"colors must be {form} with at least one channel, got {list(colors.shape)}")
    require_same_kind(means=means, colors=colors, backgrounds=backgrounds)
    if backgrounds is not None:
        depth_only = not settings.has_colors
        d = backgrounds.shape[-1] if depth_only else 3 if settings.sh_degree is not None else colors.shape[-1]
        require_shape("backgrounds", backgrounds, (*batch_dims, c, d), "[..., C, D]")
    return batch_dims, c, n
