"""Rendering of surfels, flat Gaussians that lie in a plane (Huang et al. 2024, 2D Gaussian Splatting).

The names, arguments and results are those of gsplat 1.5.3. The steps are those of `rasterization`: project, colour, bin into
tiles, blend.
"""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import (
    DenseSurfels,
    PackedSurfels,
    check_surfel_arguments,
    pack_surfels,
)
from gsplat_core.ops.depth_to_normal import depth_to_normal
from gsplat_core.ops.modes import in_plain_mode
from gsplat_core.ops.surfel_blending import rasterize_to_pixels_2dgs
from gsplat_core.ops.surfel_projection import fully_fused_projection_2dgs, sparse_gradients
from gsplat_core.ops.tiles import isect_offset_encode, isect_tiles
from gsplat_core.rendering.pipeline import Meta, Signal, check_shapes, view_colors
from gsplat_core.rendering.rasterization import step_by_step
from gsplat_core.rendering.settings import (
    CONSTANTS,
    EPS2D,
    FAR_PLANE,
    NEAR_PLANE,
    TILE_SIZE,
    Arguments,
    GsplatVersion,
    RenderSettings,
    check_tensors,
)

SurfelMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
DepthMode = Literal["expected", "median"]


@in_plain_mode
def rasterization_2dgs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
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
    packed: bool = False,
    tile_size: int = TILE_SIZE,
    backgrounds: Tensor | None = None,
    render_mode: SurfelMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
    depth_mode: DepthMode = "expected",
    *,
    constants: GsplatVersion = "1.6",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, Meta]:
    """Render surfels (Huang et al. 2024) with gsplat 1.5.3's arguments, in its order, and its results.

    Differentiable in means, quats, scales, opacities, colors, viewmats and backgrounds.

    Shapes, where `...` are any batch dimensions, common to all arguments:
        means [..., N, 3]; quats [..., N, 4] wxyz, of any length from 1e-18 to 1e18, whose rotated z axis is the normal; scales
        [..., N, 3], of which the third has no effect; opacities [..., N]; colors [..., N, D] or [..., C, N, D] when
        `sh_degree` is None, else coefficients [..., N, K, 3] or [..., C, N, K, 3] with K >= (sh_degree + 1)², displayed as
        max(0, 0.5 + sum); D may be 0 if `render_mode` has depth; viewmats [..., C, 4, 4] world to camera, OpenCV axes; Ks
        [..., C, 3, 3] in pixels, of pinhole cameras.

    Args:
        width, height: image size in pixels; the first pixel's centre is at (0.5, 0.5). Floating-point tensors are truncated.
        near_plane, far_plane: range of z in the scene's unit; surfels with a centre outside it are culled.
        radius_clip: surfels with both radii at or below this many pixels are culled.
        eps2d: without effect, as in gsplat.
        packed: `meta` holds one row per visible surfel and camera; the image is the same.
        tile_size: side of the square tiles in pixels.
        backgrounds: [..., C, D], blended behind the colours; the depth channel has background 0.
        render_mode: "RGB", "D" (z of the surfels' centres, weighted by alpha), "ED" (divided by alpha), "RGB+D" or "RGB+ED"
            (depth is the last channel).
        sparse_grad: with `packed`, gradients of means, quats and scales are sparse COO tensors of the visible surfels. Needs
            inputs without batch dimensions.
        absgrad: after backward, `meta["means2d"].absgrad` holds the sum of absolute gradients (Ye et al. 2024).
        distloss: request the distortion as a loss, which needs a `render_mode` with depth.
        depth_mode: depth of which `surf_normals` are the normals: "expected" (the depth channel) or "median".
        constants: gsplat version whose limit of alpha is used: 0.99 in "1.6", 0.999 in "1.5.3".

    Returns:
        render_colors [..., C, H, W, X], render_alphas [..., C, H, W, 1], render_normals [..., C, H, W, 3] (sums of weight
        times normal, in world axes), surf_normals (normals of the depth [..., C, H, W, 3], in world axes, 0 at the border;
        as in gsplat the first dimension is left out if it is 1, and the value is None unless `render_mode` has colours and
        depth), render_distort [..., C, H, W, 1] (L1 distortion of the last channel), render_median [..., C, H, W, 1] (last
        channel of the last surfel in front of which the transmittance exceeds 1/2), and `meta`, a dict with camera_ids and
        gaussian_ids (None unless packed), radii, means2d, depths, ray_transforms, opacities, normals, tile_width,
        tile_height, tiles_per_gauss, isect_ids, flatten_ids, isect_offsets, width, height, tile_size, n_cameras,
        render_distort and gradient_2dgs, a leaf whose gradient is the criterion of densification.

    A surfel with a NaN or an infinity in any input, or a rotation of length zero, is culled. It has radii 0, gets zero
    gradients and does not affect other surfels.

    Raises:
        InvalidInput: if a shape, dtype, device or mode does not fit; the message states the observed value.
    """
    for name, value, known in (
        ("render_mode", render_mode, get_args(SurfelMode)),
        ("depth_mode", depth_mode, get_args(DepthMode)),
    ):
        if value not in known:
            raise InvalidInput(f"unknown {name} {value!r}; rasterization_2dgs has {', '.join(known)}")
    if distloss and render_mode == "RGB":
        raise InvalidInput("distloss=True needs a render_mode with depth (D, ED, RGB+D or RGB+ED), got 'RGB'")
    settings = RenderSettings(
        width=width, height=height, near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d,
        sh_degree=sh_degree, packed=packed, tile_size=tile_size, render_mode=render_mode, absgrad=absgrad,
        constants=constants,
    )  # fmt: skip
    width, height, tile_size = settings.width, settings.height, settings.tile_size
    arguments = Arguments(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, None)
    check_tensors(arguments)
    batch_dims, n = check_shapes(arguments, settings)
    c, dims = viewmats.shape[-3], viewmats.shape[:-2]

    geometry = (means, quats, scales)
    visible: list[Tensor] = []
    if sparse_grad:
        check_surfel_arguments(*geometry, viewmats, Ks, width, height, packed, sparse_grad)
        geometry = sparse_gradients(*geometry, visible)
    projected = fully_fused_projection_2dgs(
        *geometry, viewmats, Ks, width, height, eps2d, near_plane, far_plane, radius_clip
    )
    assert isinstance(projected, DenseSurfels)
    channels, dense = None, projected
    if settings.shows(colors):
        signals = [Signal(colors, sh_degree)]
        channels, dense = view_colors(step_by_step, geometry[0], signals, viewmats, dense)
    visible.append(dense.radii)
    rows: DenseSurfels | PackedSurfels = dense
    shown = opacities[..., None, :].expand(*batch_dims, c, n)
    packing: dict[str, Any] = {}
    camera_ids = gaussian_ids = None
    if packed:
        rows = pack_surfels(dense)
        camera_ids, gaussian_ids = rows.camera_ids, rows.gaussian_ids
        image_ids = rows.batch_ids * c + camera_ids
        picked = image_ids * n + gaussian_ids
        packing = {"packed": True, "n_images": math.prod(dims), "image_ids": image_ids}
        shown = shown.reshape(-1)[picked]
        channels = None if channels is None else channels.reshape(-1, channels.shape[-1])[picked]
    if settings.has_depth or channels is None:
        depth = rows.depths[..., None]
        channels = depth if channels is None else torch.cat([channels, depth], -1)
    if backgrounds is not None:
        backgrounds = pad(backgrounds, (0, channels.shape[-1] - backgrounds.shape[-1])) if settings.has_colors else None
    tile_width, tile_height = settings.tile_grid
    tiles_per_gauss, isect_ids, flatten_ids = isect_tiles(
        rows.means2d, rows.radii, rows.depths, tile_size, tile_width, tile_height, **packing
    )
    isect_offsets = isect_offset_encode(isect_ids, math.prod(dims), tile_width, tile_height)
    isect_offsets = isect_offsets.reshape(*dims, tile_height, tile_width)
    densify = torch.zeros_like(rows.means2d, requires_grad=True)
    image, alphas, normals, distortions, medians = rasterize_to_pixels_2dgs(
        rows.means2d, rows.ray_transforms, channels, shown, rows.normals, densify, width, height, tile_size, isect_offsets,
        flatten_ids, backgrounds=backgrounds, packed=packed, absgrad=absgrad, distloss=distloss,
        max_alpha=CONSTANTS[constants].max_alpha,
    )  # fmt: skip
    if settings.divides_depth:
        image = torch.cat([image[..., :-1], image[..., -1:] / alphas.clamp(min=1e-10)], -1)
    # Not torch.linalg.inv, which waits for the device to check that the matrices are invertible.
    to_world = torch.linalg.inv_ex(viewmats).inverse
    surface = None
    if settings.has_colors and settings.has_depth:
        surface = depth_to_normal(image[..., -1:] if depth_mode == "expected" else medians, to_world, Ks).squeeze(0)
    meta: Meta = {
        "camera_ids": camera_ids,
        "gaussian_ids": gaussian_ids,
        "radii": rows.radii,
        "means2d": rows.means2d,
        "depths": rows.depths,
        "ray_transforms": rows.ray_transforms,
        "opacities": shown,
        "normals": rows.normals,
        "tile_width": tile_width,
        "tile_height": tile_height,
        "tiles_per_gauss": tiles_per_gauss,
        "isect_ids": isect_ids,
        "flatten_ids": flatten_ids,
        "isect_offsets": isect_offsets,
        "width": width,
        "height": height,
        "tile_size": tile_size,
        "n_cameras": c,
        "render_distort": distortions,
        "gradient_2dgs": densify,
    }
    normals = torch.einsum("...ij,...hwj->...hwi", to_world[..., :3, :3], normals)
    return image, alphas, normals, surface, distortions, medians, meta


def rasterization_2dgs_inria_wrapper(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = NEAR_PLANE,
    far_plane: float = 100.0,
    eps2d: float = EPS2D,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    depth_ratio: float = 0,
    **kwargs: Any,
) -> tuple[tuple[Tensor, Tensor], Meta]:
    """Render with `rasterization_2dgs`, as a stand-in for the renderer of the authors, which is not part of this package.

    Arguments and results are those of gsplat's function of this name. Further arguments are ignored, as there.

    Args:
        depth_ratio: share of the median in the depth; the rest is the expected depth.

    Returns:
        Colours with depth as the last channel [C, H, W, D + 1] and opacities [C, H, W, 1], and a dict with normals_rend,
        normals_surf, render_distloss, means2d, width, height, radii [C, N], n_cameras and gaussian_ids (None).
    """
    image, alphas, normals, _, distortions, medians, meta = rasterization_2dgs(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d=eps2d,
        sh_degree=sh_degree, backgrounds=backgrounds, render_mode="RGB+ED",
    )  # fmt: skip
    depth = image[..., -1:] * (1 - depth_ratio) + depth_ratio * medians
    surface = depth_to_normal(depth, torch.linalg.inv_ex(viewmats).inverse, Ks) * alphas.detach()
    return (torch.cat([image[..., :-1], depth], -1), alphas), {
        "normals_rend": normals,
        "normals_surf": surface,
        "render_distloss": distortions,
        "means2d": meta["means2d"],
        "width": width,
        "height": height,
        "radii": meta["radii"].amax(-1),
        "n_cameras": len(viewmats),
        "gaussian_ids": None,
    }
