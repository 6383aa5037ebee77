"""The reference under the names and with the arguments of `gsplat.cuda._torch_impl`, which gsplat's own tests call."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsplat_core.ops.arguments import DenseProjection, DenseSurfels
from gsplat_core.ops.plain_torch import proj, world_to_cam
from gsplat_core.reference.compositing import rasterize_to_pixels
from gsplat_core.reference.projection import (
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    matrix_to_triu,
    quat_scale_to_covar_preci,
    quat_to_rotmat,
)
from gsplat_core.reference.rendering import rasterization
from gsplat_core.reference.spherical_harmonics import spherical_harmonics, spherical_harmonics_bases
from gsplat_core.reference.surfels import fully_fused_projection_2dgs, rasterize_to_pixels_2dgs

_quat_to_rotmat = quat_to_rotmat
_quat_scale_to_covar_preci = quat_scale_to_covar_preci
_world_to_cam = world_to_cam
_isect_offset_encode = isect_offset_encode


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


def _spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
    return spherical_harmonics(degrees_to_use, dirs, coeffs)


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
