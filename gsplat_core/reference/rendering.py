"""Whole renderers built from the reference operations: any floating-point dtype and device, slow.

`rasterization`, and one frame from raw Gaussians and deltas, the test reference of the CUDA op `render_frame`. Functions with an
underscore are the reference under the names and with the arguments of `gsplat.cuda._torch_impl`, which gsplat's own tests call.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import (
    DenseProjection,
    DenseSurfels,
    Pairs,
    TileGrid,
    View,
    require_same_kind,
    require_shape,
)
from gsplat_core.ops.plain_torch import proj, world_to_cam
from gsplat_core.reference.compositing import blend_rays, rasterize_to_pixels, splat_rays
from gsplat_core.reference.projection import (
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    matrix_to_triu,
    quat_scale_to_covar_preci,
    quat_to_rotmat,
    spherical_harmonics,
    spherical_harmonics_bases,
    values_of_rows,
)
from gsplat_core.reference.surfels import fully_fused_projection_2dgs, rasterize_to_pixels_2dgs
from gsplat_core.rendering.pipeline import Operations
from gsplat_core.rendering.settings import RenderMode
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION


def bin_splats(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    grid: TileGrid,
    n_images: int | None = None,
    **options: Any,
) -> tuple[Tensor, Tensor, Tensor]:
    """Run `isect_tiles` (sorted) and `isect_offset_encode`; `options` are those of `isect_tiles`."""
    tiles_per_gauss, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, *grid, n_images=n_images, **options)
    images = math.prod(depths.shape[:-1]) if n_images is None else n_images
    offsets = isect_offset_encode(isect_ids, images, grid.tile_width, grid.tile_height)
    return tiles_per_gauss, flatten_ids, offsets


def bin_splats_within(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    grid: TileGrid,
    capacity: int,
    **options: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Emulate the compiled `bin_splats` with a capacity, for unpacked splats.

    Keeps the nearest splats that fit; unused entries come first.
    """
    tiles_per_gauss, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, *grid, **options)
    counts = tiles_per_gauss.reshape(-1)
    nearest_first = torch.argsort(depths.detach().reshape(-1).view(torch.int32).long() & 0xFFFFFFFF, stable=True)
    fits = torch.empty_like(counts, dtype=torch.bool)
    fits[nearest_first] = counts[nearest_first].cumsum(0) <= capacity
    listed = fits[flatten_ids.long()]
    unused = flatten_ids.new_full((capacity - int(listed.sum()),), -1)
    images = math.prod(depths.shape[:-1])
    offsets = isect_offset_encode(isect_ids[listed], images, grid.tile_width, grid.tile_height) + len(unused)
    needed = torch.tensor([len(flatten_ids)], device=depths.device)
    return tiles_per_gauss, torch.cat([unused, flatten_ids[listed]]), offsets, needed


def _pinhole_rays(*arguments: Any) -> tuple[Tensor, Tensor]:
    """Return ray coefficients and normals of Gaussians seen by a pinhole camera."""
    *tensors, camera_model = arguments
    if camera_model != "pinhole":
        raise InvalidInput(f"the reference has rays of pinhole cameras only, got {camera_model!r}")
    return splat_rays(*tensors)


def visible_harmonics(
    degree: int,
    dirs: Tensor,
    coefficients: Tensor,
    ids: Tensor,
    pairs: Pairs,
    batch_dims: int = 0,
    sparse_grad: bool = False,
) -> Tensor:
    """Return the spherical harmonics of packed rows; see `gsplat_core.ops.packed_projection`."""
    return spherical_harmonics(degree, dirs, values_of_rows(coefficients, ids, pairs, batch_dims))


rasterization = Operations(
    fully_fused_projection=fully_fused_projection,
    spherical_harmonics=spherical_harmonics,
    bin_splats=bin_splats,
    rasterize_to_pixels=rasterize_to_pixels,
    splat_rays=_pinhole_rays,
    blend_rays=blend_rays,
    values_of_rows=values_of_rows,
    visible_harmonics=visible_harmonics,
).rasterization


def render_frame(
    gaussians: Sequence[Tensor], deltas: Tensor | None, view: View, *, expected_depth: bool = False
) -> tuple[Tensor, Tensor]:
    """Deform, activate and render N Gaussians for one camera (Kerbl et al. 2023); differentiable.

    Accepts any floating dtype. A Gaussian with a non-finite parameter or delta is culled and gets zero gradients.

    Args:
        gaussians: raw parameters: means [N, 3], quats [N, 4] (wxyz, non-zero), log_scales [N, 3], logit_opacities [N],
            sh [N, B, 3] with B a square.
        deltas: [N, 16], added to the raw parameters in the layout of `scene.gaussians`, or None.
        view: camera; its tensors have the Gaussians' dtype.
        expected_depth: normalise the fourth channel to the weighted mean of z; otherwise it is the weighted sum.

    Returns:
        Image [H, W, 4] (red, green, blue, depth) and alphas [H, W].

    Raises:
        InvalidInput: for wrong shapes.
    """
    means, quats, log_scales, logit_opacities, sh = gaussians
    n, bases = len(means), sh.shape[1] if sh.dim() == 3 else 0
    require_shape("quats", quats, (n, 4), "[N, 4]")
    require_shape("log_scales", log_scales, (n, 3), "[N, 3]")
    require_shape("logit_opacities", logit_opacities, (n,), "[N]")
    degree = math.isqrt(bases) - 1
    if bases < 1 or (degree + 1) ** 2 != bases or tuple(sh.shape) != (n, bases, 3):
        raise InvalidInput(f"sh must be [N, B, 3] with N = {n} and B a square, got {list(sh.shape)}")
    raw = torch.cat([means, quats, log_scales, sh[:, 0], logit_opacities[:, None]], 1)
    if deltas is not None:
        require_shape("deltas", deltas, (n, RAW_COLUMNS), "[N, 16]")
        require_same_kind(means=means, deltas=deltas)
        raw = raw + deltas[:, : raw.shape[1]]
    # Select before any arithmetic, because a masked NaN would still reach the gradient.
    usable = (raw.isfinite().all(1) & sh.isfinite().flatten(1).all(1)).nonzero()[:, 0]
    mean, quat, log_scale, dc, logit = (
        raw[usable][:, group] for group in (POSITION, ROTATION, LOG_SCALE, COLOUR, OPACITY)
    )
    mode: RenderMode = "RGB+ED" if expected_depth else "RGB+D"
    background = None if view.background is None else view.background[None]
    image, alphas, _ = rasterization(
        mean, quat, log_scale.exp(), torch.sigmoid(logit[:, 0]), torch.cat([dc[:, None], sh[usable, 1:]], 1),
        view.viewmat[None], view.K[None], view.width, view.height, near_plane=view.near_plane, far_plane=view.far_plane,
        eps2d=view.eps2d, sh_degree=degree, packed=False, backgrounds=background, render_mode=mode,
        camera_model=view.camera_model,
    )  # fmt: skip
    return image[0], alphas[0, ..., 0]


_quat_to_rotmat = quat_to_rotmat
_quat_scale_to_covar_preci = quat_scale_to_covar_preci
_world_to_cam = world_to_cam
_isect_offset_encode = isect_offset_encode
_spherical_harmonics = spherical_harmonics


def _quat_scale_to_matrix(quats: Tensor, scales: Tensor) -> Tensor:
    return quat_to_rotmat(quats) * scales[..., None, :]


def _persp_proj(means: Tensor, covars: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    return proj(means, covars, Ks, width, height, "pinhole")


def _ortho_proj(means: Tensor, covars: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    return proj(means, covars, Ks, width, height, "ortho")


def _fisheye_proj(means: Tensor, covars: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    return proj(means, covars, Ks, width, height, "fisheye")


def _fully_fused_projection(
    means: Tensor, covars: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, eps2d: float = 0.3,
    near_plane: float = 0.01, far_plane: float = 1e10, calc_compensations: bool = False, camera_model: str = "pinhole",
) -> DenseProjection:  # fmt: skip
    projected = fully_fused_projection(
        means, matrix_to_triu(covars), None, None, viewmats, Ks, width, height, eps2d, near_plane, far_plane,
        calc_compensations=calc_compensations, camera_model=camera_model,
    )  # fmt: skip
    assert isinstance(projected, DenseProjection)
    return projected


@torch.no_grad()
def _isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int, sort: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    return isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, sort)


def _rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int, image_height: int,
    tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor, backgrounds: Tensor | None = None,
    batch_per_iter: int = 100,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    return rasterize_to_pixels(
        means2d,
        conics,
        colors,
        opacities,
        image_width,
        image_height,
        tile_size,
        isect_offsets,
        flatten_ids,
        backgrounds,
    )


def _eval_sh_bases_fast(basis_dim: int, dirs: Tensor) -> Tensor:
    return spherical_harmonics_bases(math.isqrt(basis_dim) - 1, dirs)


def _rasterization(*arguments: Any, batch_per_iter: int = 100, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    return rasterization(*arguments, **{"packed": False} | options)


def _fully_fused_projection_2dgs(
    means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int,
    near_plane: float = 0.01, far_plane: float = 1e10, eps: float = 0,
) -> DenseSurfels:  # fmt: skip
    projected = fully_fused_projection_2dgs(
        means, quats, scales, viewmats, Ks, width, height, near_plane=near_plane, far_plane=far_plane
    )
    assert isinstance(projected, DenseSurfels)
    return projected


def _rasterize_to_pixels_2dgs(
    means2d: Tensor, ray_transforms: Tensor, colors: Tensor, normals: Tensor, opacities: Tensor, image_width: int,
    image_height: int, tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor, backgrounds: Tensor | None = None,
    batch_per_iter: int = 100,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    colors, alphas, normals, _, _ = rasterize_to_pixels_2dgs(
        means2d, ray_transforms, colors, opacities, normals, torch.zeros_like(means2d), image_width, image_height,
        tile_size, isect_offsets, flatten_ids, backgrounds,
    )  # fmt: skip
    return colors, alphas, normals
