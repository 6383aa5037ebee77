"""Whole renderers built from the reference operations: any floating-point dtype and device, slow.

`rasterization`; one frame from raw Gaussians and deltas, the test reference of the CUDA op `render_frame`; one frame of
weighted sums, the test reference of `render_weighted_frame`; and expectation and variance of the sort-free renderers. Functions with an underscore are the reference under the names and
with the arguments of `gsplat.cuda._torch_impl`, which gsplat's own tests call.

Stochastic transparency is alpha blending without early stop. In Gaussian point splatting (Rijsdijk et al., TOG 2026),
the number of points of a splat in a pixel is Poisson distributed with the integral of -ln(1 - o G) over the pixel. Both
evaluate every splat at every pixel, so they are for small scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import (
    ALPHA_CUTOFF,
    DenseProjection,
    DenseSurfels,
    Pairs,
    TileGrid,
    View,
    require_same_kind,
    require_shape,
)
from gsplat_core.ops.plain_torch import proj, world_to_cam
from gsplat_core.reference.compositing import ALPHA_MAX, blend_rays, rasterize_to_pixels, splat_rays, weighted_sums
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
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION, Gaussians


def bin_splats(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    grid: TileGrid,
    n_images: int | None = None,
    **options: Any,
) -> tuple[Tensor, Tensor, Tensor]:
    """Bin splats into tiles and sort each tile's list by depth. Return tiles_per_gauss, flatten_ids and isect_offsets.

    `options` are those of `isect_tiles`.
    """
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

    Keeps the nearest splats that fit; unused entries come first. Returns tiles_per_gauss, flatten_ids, isect_offsets and the
    needed capacity, int64 [1].
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
    """Return the spherical harmonics of visible (camera, Gaussian) pairs, in rows. `sparse_grad` has no effect; gradients are
    dense.
    """
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


def render_weighted_frame(
    gaussians: Sequence[Tensor],
    opacity_harmonics: Tensor,
    factors: Tensor,
    scalars: tuple[Tensor, Tensor, Tensor],
    view: View,
    *,
    least_total: float,
    least_share: float,
) -> tuple[Tensor, Tensor]:
    """Render N Gaussians by weighted sums (Hou et al. 2024); the arguments are those of `ops.frame.render_weighted_frame`.

    Evaluates every Gaussian at every pixel, without rounding to fixed point. Gaussians with a non-finite value are culled.

    Returns:
        Image [H, W, 4] (red, green, blue, mean z) and alphas [H, W].
    """
    sigma, distance, behind = scalars
    usable = torch.cat([t.flatten(1) if t.dim() > 1 else t[:, None] for t in (*gaussians, opacity_harmonics)], 1)
    rows = (usable.isfinite().all(1) & factors.isfinite()).nonzero()[:, 0]
    means, quats, log_scales, _, sh = (t[rows] for t in gaussians)
    directions = means + view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    harmonics = opacity_harmonics[rows][..., None].expand(-1, -1, 3)
    opacities = spherical_harmonics(math.isqrt(harmonics.shape[1]) - 1, directions, harmonics)[:, 0]
    projected = fully_fused_projection(
        means, None, quats, log_scales.exp(), view.viewmat[None], view.K[None], view.width, view.height,
        eps2d=view.eps2d, near_plane=view.near_plane, far_plane=view.far_plane, camera_model=view.camera_model,
        opacities=opacities.abs().clamp(max=1),
    )  # fmt: skip
    radii, means2d, depths, conics = (t[0] for t in projected[:4])
    seen = (radii > 0).any(-1).nonzero()[:, 0]
    colors = (spherical_harmonics(math.isqrt(sh.shape[1]) - 1, directions, sh) + 0.5).clamp(min=0)
    channels = torch.cat([colors, (depths / distance)[:, None]], 1)
    weights = (1 - depths / sigma).clamp(min=0) * factors[rows]
    sums = weighted_sums(
        means2d[seen], conics[seen], channels[seen], opacities[seen], weights[seen], view.width, view.height
    )
    total = (sums[-1] + behind).clamp(min=least_total)
    color = sums[:3] if view.background is None else sums[:3] + (behind * view.background)[:, None, None]
    z = torch.where(sums[-1] > least_share, sums[3] / sums[-1] * distance, 0)
    return torch.cat([color / total, z[None]]).permute(1, 2, 0), 1 - (behind / total).clamp(max=1)


class SampleMoments(NamedTuple):
    """Mean and variance of one random sample of each pixel, in which a sample is red, green, blue, hit (0 or 1) and z."""

    mean: Tensor
    """Mean of red, green, blue, hit and z of each pixel, [H, W, 5]."""
    variance: Tensor
    """Variance of red, green, blue, hit and z of each pixel, [H, W, 5]."""


class ProjectedSplats(NamedTuple):
    """Visible splats sorted by depth; splats of equal depth by their row."""

    means2d: Tensor
    """Projected centres [M, 2] in pixels."""
    conics: Tensor
    """Inverse 2D covariances as (xx, xy, yy), [M, 3]."""
    opacities: Tensor
    depths: Tensor
    colors: Tensor
    """Colours [M, 3], not negative."""
    rows: Tensor


def project_splats(gaussians: Gaussians, camera: Camera) -> ProjectedSplats:
    """Project Gaussians and evaluate their colours for a camera."""
    viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
    radii, means2d, depths, conics, *_ = fully_fused_projection(
        gaussians.means,
        None,
        gaussians.quats,
        gaussians.scales,
        viewmat[None],
        intrinsics[None],
        camera.width_px,
        camera.height_px,
        opacities=gaussians.opacities,
        camera_model=camera.model,
    )
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    colors = spherical_harmonics(gaussians.sh_degree, gaussians.means - centre, gaussians.sh)
    rows = (radii[0] > 0).any(-1).nonzero()[:, 0]
    rows = rows[depths[0, rows].argsort(stable=True)]
    return ProjectedSplats(
        means2d[0, rows],
        conics[0, rows],
        gaussians.opacities[rows],
        depths[0, rows],
        (colors[rows] + 0.5).clamp_min(0),
        rows,
    )


def densities(splats: ProjectedSplats, points: Tensor) -> Tensor:
    """Return each splat's opacity times its 2D Gaussian at points [P, 2], [M, P]; 0 where it is below 1/255."""
    d = points[None] - splats.means2d[:, None]
    a, b, c = (splats.conics[:, None, k] for k in range(3))
    power = 0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) + b * d[..., 0] * d[..., 1]
    alpha = splats.opacities[:, None] * torch.exp(-power)
    return torch.where(alpha >= ALPHA_CUTOFF, alpha, 0)


def pixel_centres(camera: Camera, like: Tensor, supersampling: int = 1) -> Tensor:
    """Return the centres of all sub-pixels [H S * W S, 2] in pixels."""
    x = (torch.arange(camera.width_px * supersampling, device=like.device, dtype=like.dtype) + 0.5) / supersampling
    y = (torch.arange(camera.height_px * supersampling, device=like.device, dtype=like.dtype) + 0.5) / supersampling
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)


def fragment_alphas(splats: ProjectedSplats, centres: Tensor, supersampling: int) -> Tensor:
    """Return the probability that each splat hits each sub-pixel, [M, P]."""
    return densities(splats, centres).clamp_max(ALPHA_MAX)


def sample_moments(
    gaussians: Gaussians,
    camera: Camera,
    supersampling: int = 1,
    alphas_at: Callable[[ProjectedSplats, Tensor, int], Tensor] = fragment_alphas,
) -> SampleMoments:
    """Return mean and variance of one sample, over a black background.

    Sub-pixels are independent: the moments are those of the mean over the sub-pixels of a pixel.

    Args:
        gaussians: scene.
        camera: camera of the picture.
        supersampling: sub-pixels per pixel and axis.
        alphas_at: function that returns the probability of a hit; `fragment_alphas` for stochastic transparency.
    """
    splats = project_splats(gaussians, camera)
    alphas = alphas_at(splats, pixel_centres(camera, gaussians.means, supersampling), supersampling)
    in_front = torch.cumprod(torch.cat([torch.ones_like(alphas[:1]), 1 - alphas]), 0)[:-1]
    weights = (alphas * in_front).T  # [P, M]
    values = torch.cat([splats.colors, torch.ones_like(splats.depths[:, None]), splats.depths[:, None]], -1)
    mean = weights @ values
    variance = (weights @ values**2 - mean**2).clamp_min(0)
    s = supersampling
    shape = (camera.height_px, s, camera.width_px, s, 5)
    return SampleMoments(mean.view(shape).mean((1, 3)), variance.view(shape).mean((1, 3)) / s**2)


QUADRATURE = 8
"""Points per axis of a sub-pixel at which a splat's rate of points (expected number per sub-pixel) is evaluated."""


def dilogarithm(x: Tensor) -> Tensor:
    """Return Li2(x) = Σ xᵏ/k² for 0 <= x <= 1."""
    k = torch.arange(1, 80, device=x.device, dtype=x.dtype)
    series = lambda y: (y[..., None] ** k / k**2).sum(-1)
    y = x.clamp(1e-30, 1 - 1e-15)
    return torch.where(
        x <= 0.5, series(x.clamp_max(0.5)), torch.pi**2 / 6 - y.log() * (1 - y).log() - series((1 - y).clamp_max(0.5))
    )


def point_alphas(splats: ProjectedSplats, centres: Tensor, supersampling: int, quadrature: int = QUADRATURE) -> Tensor:
    """Return the probability that each splat has a point in each sub-pixel, [M, P]."""
    limited = splats._replace(opacities=splats.opacities.clamp_max(ALPHA_MAX))
    offsets = (torch.arange(quadrature, device=centres.device, dtype=centres.dtype) + 0.5) / quadrature - 0.5
    rate = torch.zeros((), device=centres.device, dtype=centres.dtype)
    for x in offsets.tolist():
        for y in offsets.tolist():
            places = centres + torch.tensor([x, y], device=centres.device, dtype=centres.dtype) / supersampling
            rate = rate - torch.log1p(-densities(limited, places))
    return -torch.expm1(-rate / quadrature**2)


def point_moments(
    gaussians: Gaussians, camera: Camera, supersampling: int = 1, quadrature: int = QUADRATURE
) -> SampleMoments:
    """Return mean and variance of one sample of point splatting, over a black background.

    Args:
        gaussians: scene.
        camera: camera of the picture.
        supersampling: sub-pixels per pixel and axis.
        quadrature: points per axis of a sub-pixel at which the rate is evaluated.
    """
    return sample_moments(gaussians, camera, supersampling, partial(point_alphas, quadrature=quadrature))


_quat_to_rotmat = quat_to_rotmat
_quat_scale_to_covar_preci = quat_scale_to_covar_preci
_world_to_cam = world_to_cam
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


def _isect_offset_encode(isect_ids: Tensor, I: int, tile_width: int, tile_height: int) -> Tensor:
    return isect_offset_encode(isect_ids, I, tile_width, tile_height)


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
