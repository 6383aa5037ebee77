"""Argument checks and result types of surfel projection, shared by the compiled op and the reference."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_same_kind, require_shape, require_trailing
from gsplat_core.errors import InvalidInput

LEAST_EXTENT_SQUARED = 1e-4
"""Lower limit in pixels² of a surfel's squared half width or half height at one standard deviation."""


class DenseSurfels(NamedTuple):
    """Results of a projection with one row per camera and surfel; zeros where the surfel is culled."""

    radii: Tensor
    """Half width and half height of the bounding box in pixels, int32 [..., C, N, 2]; (0, 0) = culled."""
    means2d: Tensor
    """Centres of the bounding boxes at one standard deviation [..., C, N, 2] in pixels."""
    depths: Tensor
    """Camera-space z of the surfels' centres [..., C, N]."""
    ray_transforms: Tensor
    """Homographies [..., C, N, 3, 3] from (u, v, 1), in standard deviations on the surfel, to homogeneous pixels."""
    normals: Tensor
    """Unit normals in camera axes, towards the camera, [..., C, N, 3]."""


class PackedSurfels(NamedTuple):
    """Results of a projection with one row per camera and surfel that is not culled, ordered by batch, camera, surfel."""

    batch_ids: Tensor
    """Batch index of each row, int64 [nnz], over the flattened batch dimensions."""
    camera_ids: Tensor
    """Camera index of each row, int64 [nnz]."""
    gaussian_ids: Tensor
    """Surfel index of each row, int64 [nnz]."""
    radii: Tensor
    means2d: Tensor
    depths: Tensor
    ray_transforms: Tensor
    normals: Tensor


def check_surfel_arguments(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    packed: bool,
    sparse_grad: bool,
) -> tuple[int, ...]:
    """Check shapes, dtypes, devices and options of a projection; return the batch dimensions.

    Raises:
        InvalidInput: if they do not match.
    """
    *batch, n = require_trailing("means", means, (3,), "[..., N, 3]") or (None,)
    if n is None:
        raise InvalidInput(f"means must be [..., N, 3], got {list(means.shape)}")
    batch_dims = tuple(batch)
    require_shape("quats", quats, (*batch_dims, n, 4), "[..., N, 4]")
    require_shape("scales", scales, (*batch_dims, n, 3), "[..., N, 3]")
    c = viewmats.shape[-3] if viewmats.dim() >= 3 else 0
    require_shape("viewmats", viewmats, (*batch_dims, c, 4, 4), "[..., C, 4, 4]")
    require_shape("Ks", Ks, (*batch_dims, c, 3, 3), "[..., C, 3, 3]")
    require_same_kind(means=means, quats=quats, scales=scales, viewmats=viewmats, Ks=Ks)
    if width < 1 or height < 1:
        raise InvalidInput(f"the image must be at least 1x1 px, got width={width}, height={height}")
    if sparse_grad and (not packed or batch_dims):
        raise InvalidInput(
            f"sparse_grad=True needs packed=True and means [N, 3] without batch dimensions, got packed={packed} and"
            f" {list(means.shape)}"
        )
    return batch_dims


def pack_surfels(dense: DenseSurfels) -> PackedSurfels:
    """Keep only the rows that are not culled."""
    n_cameras, n_surfels = dense.radii.shape[-3:-1]
    rows = dense.radii.detach().reshape(-1, 2)[:, 0].nonzero().squeeze(-1)
    images = torch.div(rows, max(n_surfels, 1), rounding_mode="floor")
    return PackedSurfels(
        batch_ids=torch.div(images, max(n_cameras, 1), rounding_mode="floor"),
        camera_ids=images % max(n_cameras, 1),
        gaussian_ids=rows % max(n_surfels, 1),
        radii=dense.radii.reshape(-1, 2)[rows],
        means2d=dense.means2d.reshape(-1, 2)[rows],
        depths=dense.depths.reshape(-1)[rows],
        ray_transforms=dense.ray_transforms.reshape(-1, 3, 3)[rows],
        normals=dense.normals.reshape(-1, 3)[rows],
    )
