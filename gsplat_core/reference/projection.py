"""Steps from 3D Gaussians to coloured splats in tiles, in plain torch: test reference of the compiled ops.

Projection to screen-space ellipses (EWA splatting, Zwicker et al. 2001), covariance and precision matrices (Kerbl et
al. 2023, equation 6), binning into tiles, and real spherical harmonics up to degree 4 (Sloan 2013, "Efficient Spherical
Harmonic Evaluation").
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.arguments import (
    ALPHA_CUTOFF,
    COMPENSATION_FLOOR,
    MAX_EXTENT_SIGMAS,
    MAX_RADIUS_PX,
    DenseProjection,
    PackedProjection,
    Pairs,
    check_covariance_arguments,
    check_projection_options,
    check_projection_tensors,
    check_sparse_gradient,
    check_spherical_harmonics_arguments,
)
from gsplat_core.ops.plain_torch import PROJECTIONS

TRIU_ROWS = (0, 0, 0, 1, 1, 2)
TRIU_COLUMNS = (0, 1, 2, 1, 2, 2)


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Convert quaternions [..., 4] (wxyz, any non-zero length) to rotation matrices [..., 3, 3]."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


def matrix_to_triu(matrix: Tensor) -> Tensor:
    """Return the upper triangles (xx, xy, xz, yy, yz, zz) [..., 6] of matrices [..., 3, 3]."""
    return matrix[..., TRIU_ROWS, TRIU_COLUMNS]


def triu_to_matrix(triu: Tensor) -> Tensor:
    """Return symmetric matrices [..., 3, 3] from upper triangles [..., 6]."""
    return triu[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*triu.shape[:-1], 3, 3)


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Compute covariances R S S Rᵀ and precisions R S⁻¹ S⁻¹ Rᵀ (Kerbl et al. 2023, eq. 6).

    See `gsplat_core.quat_scale_to_covar_preci`.
    """
    check_covariance_arguments(quats, scales)
    rotation = quat_to_rotmat(quats)

    def outer(factors: Tensor) -> Tensor:
        half = rotation * factors[..., None, :]
        matrix = half @ half.transpose(-1, -2)
        return matrix_to_triu(matrix) if triu else matrix

    return outer(scales) if compute_covar else None, outer(1 / scales) if compute_preci else None


def fully_fused_projection(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    opacities: Tensor | None = None,
    *,
    compensation_floor: float = COMPENSATION_FLOOR,
) -> DenseProjection | PackedProjection:
    """Project 3D Gaussians to 2D image Gaussians by EWA splatting (Zwicker et al. 2001).

    See `gsplat_core.fully_fused_projection`. Gradients are dense also with sparse_grad.
    """
    batch_dims = check_projection_tensors(means, covars, quats, scales, opacities, viewmats, Ks)
    check_projection_options(width, height, camera_model, compensation_floor)
    check_sparse_gradient(sparse_grad, packed, batch_dims)
    # Replace unusable Gaussians before any arithmetic, because a masked NaN would reach the gradient.
    usable = _usable(means, covars, quats, scales, opacities)
    covariance = _covariance(usable, covars, quats, scales)
    means = torch.where(usable[..., None], means, torch.zeros_like(means))
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    p = torch.einsum("...cij,...nj->...cni", rotation, means) + translation[..., None, :]
    z = p[..., 2]
    in_range = usable[..., None, :] & (z >= near_plane) & (z <= far_plane)
    p = torch.where(in_range[..., None], p, p.new_tensor([0, 0, 1]))
    means2d, jacobian = PROJECTIONS[camera_model](p, Ks, width, height)

    # covariance in the image: (J W) Σ (J W)ᵀ
    affine = jacobian @ rotation[..., None, :, :]
    ellipses = _blurred(affine @ covariance[..., None, :, :, :] @ affine.transpose(-1, -2), eps2d, compensation_floor)
    valid = in_range & ellipses.positive & means2d.isfinite().all(-1) & ellipses.conics.isfinite().all(-1)
    reached = None
    if opacities is not None:
        reached = opacities[..., None, :] * (ellipses.compensations if calc_compensations else 1)
    half_sizes, visible = _half_sizes(ellipses, reached)
    with torch.no_grad():
        valid = valid & visible & (half_sizes > radius_clip).any(-1)
        size = means2d.new_tensor([width, height])
        valid = valid & ((means2d + half_sizes > 0) & (means2d - half_sizes < size)).all(-1)

    zero = torch.zeros_like(z)
    dense = DenseProjection(
        radii=torch.where(valid[..., None], half_sizes, zero[..., None]).to(torch.int32),
        means2d=torch.where(valid[..., None], means2d, zero[..., None]),
        depths=torch.where(valid, p[..., 2], zero),
        conics=torch.where(valid[..., None], ellipses.conics, zero[..., None]),
        compensations=torch.where(valid, ellipses.compensations, zero) if calc_compensations else None,
    )
    return pack(dense) if packed else dense


def _usable(
    means: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None, opacities: Tensor | None
) -> Tensor:
    """Return a mask [..., N] of Gaussians with finite values and a non-zero quaternion."""
    usable = means.isfinite().all(-1)
    if covars is not None:
        usable = usable & covars.isfinite().all(-1)
    elif quats is not None and scales is not None:
        usable = usable & quats.isfinite().all(-1) & (quats != 0).any(-1) & scales.isfinite().all(-1)
    if opacities is not None:
        usable = usable & opacities.isfinite()
    return usable


def _covariance(usable: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None) -> Tensor:
    """Return world-space covariances [..., N, 3, 3]; the identity for unusable Gaussians."""
    if covars is not None:
        identity = covars.new_tensor([1, 0, 0, 1, 0, 1])
        return triu_to_matrix(torch.where(usable[..., None], covars, identity))
    assert quats is not None and scales is not None
    quats = torch.where(usable[..., None], quats, quats.new_tensor([1, 0, 0, 0]))
    scales = torch.where(usable[..., None], scales, torch.ones_like(scales))
    covar, _ = quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    assert covar is not None
    return covar


class _Ellipses(NamedTuple):
    """Blurred 2D covariances of splats, [..., C, N]."""

    variances: Tensor
    """Variances along x and y in pixels², [..., C, N, 2]."""
    conics: Tensor
    compensations: Tensor
    positive: Tensor
    """Mask of invertible 2D covariances, bool; elsewhere the conic is meaningless."""


def _blurred(covars2d: Tensor, eps2d: float, compensation_floor: float) -> _Ellipses:
    a0, b, c0 = covars2d[..., 0, 0], covars2d[..., 0, 1], covars2d[..., 1, 1]
    a, c = a0 + eps2d, c0 + eps2d
    det = a * c - b * b
    positive = det > 0
    det = torch.where(positive, det, torch.ones_like(det))
    conics = torch.stack([c / det, -b / det, a / det], -1)
    ratio = (a0 * c0 - b * b) / det
    # `clamp` is not used, because at a floor of 0 the square root's gradient is infinite.
    above = ratio > compensation_floor**2
    compensations = torch.where(above, torch.where(above, ratio, 1).sqrt(), compensation_floor)
    return _Ellipses(torch.stack([a, c], -1), conics, compensations, positive)


@torch.no_grad()
def _half_sizes(ellipses: _Ellipses, opacities: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return half width and height in pixels [..., C, N, 2] of the bounding box of the pixels where alpha is at least 1/255.

    Also returns a mask [..., C, N] of the Gaussians whose alpha reaches 1/255 anywhere.
    """
    extent = torch.full_like(ellipses.compensations, MAX_EXTENT_SIGMAS)
    visible = torch.ones_like(ellipses.positive)
    if opacities is not None:
        visible = opacities >= ALPHA_CUTOFF
        extent = extent.minimum((2 * (opacities / ALPHA_CUTOFF).clamp(min=1).log()).sqrt())
    half_sizes = (extent[..., None] * ellipses.variances.clamp(min=0).sqrt()).ceil().clamp(max=MAX_RADIUS_PX)
    return half_sizes, visible


def pack(dense: DenseProjection) -> PackedProjection:
    """Return the packed projection: one row for each pair of camera and Gaussian that is not culled."""
    n_cameras, n_gaussians = dense.radii.shape[-3:-1]
    rows = dense.radii.detach().reshape(-1, 2)[:, 0].nonzero().squeeze(-1)
    images = torch.div(rows, max(n_gaussians, 1), rounding_mode="floor")
    compensations = dense.compensations
    return PackedProjection(
        batch_ids=torch.div(images, max(n_cameras, 1), rounding_mode="floor"),
        camera_ids=images % max(n_cameras, 1),
        gaussian_ids=rows % max(n_gaussians, 1),
        radii=dense.radii.reshape(-1, 2)[rows],
        means2d=dense.means2d.reshape(-1, 2)[rows],
        depths=dense.depths.reshape(-1)[rows],
        conics=dense.conics.reshape(-1, 3)[rows],
        compensations=None if compensations is None else compensations.reshape(-1)[rows],
    )


def values_of_rows(values: Tensor, ids: Tensor, pairs: Pairs, batch_dims: int = 0, sparse_grad: bool = False) -> Tensor:
    """Return the values of packed rows from those of the Gaussians; see `gsplat_core.ops.packed_projection`."""
    return values.flatten(0, batch_dims)[pairs.gaussians_of(ids)]


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
    *,
    conics: Tensor | None = None,
    opacities: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """List the tiles that each splat touches; see `gsplat_core.isect_tiles`."""
    count = depths.numel()
    images = (n_images or 0) if packed else math.prod(depths.shape[:-1])
    means = means2d.reshape(-1, 2)
    reach = radii.reshape(-1, 2)
    if packed:
        assert image_ids is not None
        image = image_ids.long()
    else:
        image = torch.arange(count, device=depths.device) // max(depths.shape[-1], 1)
    visible = (reach > 0).all(-1) & means.isfinite().all(-1) & depths.reshape(-1).isfinite()
    grid = torch.tensor([tile_width, tile_height], device=depths.device)
    zero = torch.zeros_like(grid)
    low = ((means - reach) / tile_size).nan_to_num().clamp(zero, grid).floor().long()
    high = ((means + reach) / tile_size).nan_to_num().clamp(zero, grid).ceil().long()
    extent = torch.where(visible[:, None], high - low, 0).clamp(min=0)
    tiles_of = extent.prod(-1)
    splat = torch.repeat_interleave(torch.arange(count, device=depths.device), tiles_of)
    inside = torch.arange(len(splat), device=depths.device) - (tiles_of.cumsum(0) - tiles_of)[splat]
    column = low[splat, 0] + inside % extent[splat, 0].clamp(min=1)
    row = low[splat, 1] + inside // extent[splat, 0].clamp(min=1)
    if conics is not None and opacities is not None:
        touched = _ellipse_touches(
            means[splat], conics.reshape(-1, 3)[splat], opacities.reshape(-1)[splat], column, row, tile_size
        )
        splat, column, row = splat[touched], column[touched], row[touched]
        tiles_of = torch.bincount(splat, minlength=count)
    tile = row * tile_width + column
    tile_bits = (tile_width * tile_height).bit_length()
    depth_bits = depths.reshape(-1).float().contiguous().view(torch.int32).long() & 0xFFFFFFFF
    ids = (image[splat] << (32 + tile_bits)) | (tile << 32) | depth_bits[splat]
    if sort:
        ids, order = torch.sort(ids, stable=True)
        splat = splat[order]
    if packed:
        return tiles_of.int(), ids, splat.int()
    assert images * depths.shape[-1] == count
    return tiles_of.int().reshape(depths.shape), ids, splat.int()


def _ellipse_touches(
    means: Tensor, conics: Tensor, opacities: Tensor, column: Tensor, row: Tensor, size: int
) -> Tensor:
    """Return True for tiles in which alpha reaches 1/255 within the rectangle of pixel centres.

    Sigma is convex there, so its minimum is at the mean or on an edge.
    """
    low = torch.stack([column, row], -1) * size + 0.5 - means
    high = low + (size - 1)
    a, b, c = conics.unbind(-1)

    def sigma(dx: Tensor, dy: Tensor) -> Tensor:
        return 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy

    least = torch.full_like(a, math.inf)
    for dx in (low[:, 0], high[:, 0]):  # along a vertical edge, sigma is smallest where its derivative by y is 0
        least = torch.minimum(least, sigma(dx, torch.minimum(torch.maximum(-b * dx / c, low[:, 1]), high[:, 1])))
    for dy in (low[:, 1], high[:, 1]):
        least = torch.minimum(least, sigma(torch.minimum(torch.maximum(-b * dy / a, low[:, 0]), high[:, 0]), dy))
    within = ((low <= 0) & (high >= 0)).all(-1)
    least = torch.where(within, torch.zeros_like(least), least)
    proper = (a > 0) & (c > 0) & (a * c - b * b > 0)
    usable = conics.isfinite().all(-1) & opacities.isfinite() & (opacities * 255 >= 1)
    return usable & (~proper | (opacities * torch.exp(-least) >= 1 / 255))


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Return the start of each tile's entries in the sorted `isect_ids`.

    Returns:
        int32 [n_images, tile_height, tile_width].
    """
    tiles = tile_width * tile_height
    tile_bits = tiles.bit_length()
    key = isect_ids >> 32
    tile = (key >> tile_bits) * tiles + (key & ((1 << tile_bits) - 1))
    starts = torch.searchsorted(tile, torch.arange(n_images * tiles, device=isect_ids.device))
    return starts.int().reshape(n_images, tile_height, tile_width)


def spherical_harmonics_bases(degree: int, directions: Tensor) -> Tensor:
    """Evaluate the (degree + 1)² real basis functions [..., K] at unit directions [..., 3].

    Order and signs are those of 3DGS (Kerbl et al. 2023).
    """
    x, y, z = directions.unbind(-1)
    bases = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        bases += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        c2, s2 = xx - yy, 2 * x * y
        bases += [
            0.5462742152960395 * s2,
            -1.0925484305920792 * y * z,
            0.9461746957575601 * zz - 0.31539156525252005,
            -1.0925484305920792 * x * z,
            0.5462742152960395 * c2,
        ]
    if degree >= 3:
        c3, s3 = x * c2 - y * s2, x * s2 + y * c2
        lift = 0.4570457994644658 - 2.285228997322329 * zz
        bases += [
            -0.5900435899266435 * s3,
            1.445305721320277 * z * s2,
            lift * y,
            z * (1.865881662950577 * zz - 1.1195289977703462),
            lift * x,
            1.445305721320277 * z * c2,
            -0.5900435899266435 * c3,
        ]
    if degree >= 4:
        c4, s4 = x * c3 - y * s3, x * s3 + y * c3
        tilt = z * (2.0071396306718676 - 4.683325804901025 * zz)
        ring = 3.31161143515146 * zz - 0.47308734787878
        bases += [
            0.6258357354491761 * s4,
            -1.7701307697799304 * z * s3,
            ring * s2,
            tilt * y,
            0.10578554691520431 * (35 * zz * zz - 30 * zz + 3),
            tilt * x,
            ring * c2,
            -1.7701307697799304 * z * c3,
            0.6258357354491761 * c4,
        ]
    return torch.stack(bases, -1)


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Evaluate sums of spherical harmonics; see `gsplat_core.spherical_harmonics`."""
    check_spherical_harmonics_arguments(degrees_to_use, dirs, coeffs, masks)
    count = (degrees_to_use + 1) ** 2
    coeffs = coeffs[..., :count, :]
    if masks is not None:
        # Replace before any arithmetic, because a masked NaN would still reach the gradient.
        dirs = torch.where(masks[..., None], dirs, torch.ones_like(dirs))
        coeffs = torch.where(masks[..., None, None], coeffs, torch.zeros_like(coeffs))
    if degrees_to_use == 0:
        bases = torch.full_like(dirs[..., :1], 0.28209479177387814)
    else:
        bases = spherical_harmonics_bases(degrees_to_use, dirs / dirs.norm(dim=-1, keepdim=True))
    return (bases[..., None] * coeffs).sum(-2)
