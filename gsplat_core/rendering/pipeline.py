"""`rasterization` with gsplat's arguments and results, for any implementation of the operations.

The pipeline has four steps: project, colour, bin into tiles, blend. `rasterization()` and training run it with the
compiled operations, tests with those in plain torch. On CUDA, `SingleCall` does the same in one native call.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import (
    DenseProjection,
    DenseSurfels,
    PackedProjection,
    Pairs,
    TileGrid,
    require_same_kind,
    require_shape,
)
from gsplat_core.rendering.settings import (
    CONSTANTS,
    EPS2D,
    FAR_PLANE,
    NEAR_PLANE,
    TILE_SIZE,
    Arguments,
    GsplatVersion,
    RasterizeMode,
    RenderMode,
    RenderSettings,
    SparseGradients,
    check_tensors,
    refuse_unsupported,
    signature_of,
)

if TYPE_CHECKING:
    from gsplat_core.ops.rasterization import Rasterized
    from gsplat_core.rendering.rasterization import SingleCall


@dataclass(frozen=True)
class StepOperations:
    """One implementation of the pipeline's operations, with gsplat's names and signatures."""

    fully_fused_projection: Callable[..., Any]
    spherical_harmonics: Callable[..., Tensor]
    bin_splats: Callable[..., tuple[Tensor, Tensor, Tensor]]
    rasterize_to_pixels: Callable[..., tuple[Tensor, ...]]
    """Function that returns colours, alphas, and further values that `render_splats` passes on to its caller."""
    splat_rays: Callable[..., tuple[Tensor, Tensor]] | None = None
    blend_rays: Callable[..., tuple[Tensor, ...]] | None = None
    """Function that blends the distance along rays and the normals, as in `gsplat_core.ops.ray_blending`. Its input
    comes from `splat_rays`.
    """
    values_of_rows: Callable[..., Tensor] | None = None
    visible_harmonics: Callable[..., Tensor] | None = None
    """Function that evaluates the spherical harmonics of packed rows (visible pairs of camera and Gaussian), as in
    `gsplat_core.ops.packed_projection`.
    """
    zero_gradients_stay_zero: bool = False
    """True if a zero gradient stays zero in backward operations, even times NaN, as on CUDA."""


class Geometry(NamedTuple):
    """Gaussians without colours, and cameras; shapes as in `rasterization`."""

    means: Tensor
    covars: Tensor | None
    """Upper triangles of the covariances [..., N, 6]; None if quaternions and scales are given."""
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    viewmats: Tensor
    Ks: Tensor


class RenderedSplats(NamedTuple):
    """Rendered images and intermediate results.

    A row is a pair of Gaussian and camera, or a visible pair if packed.
    """

    image: Tensor
    """Rendered channels [..., C, H, W, channels]: colours, then the sum of weight times z if depth is rendered."""
    alphas: Tensor
    rows: DenseProjection | PackedProjection
    channels: Tensor
    """Values of each splat that were blended, such as colours and depth, [rows, channels]."""
    opacities: Tensor
    """Opacities [rows] including the antialiasing compensation."""
    tiles_per_gauss: Tensor
    flatten_ids: Tensor
    isect_offsets: Tensor
    nearness: Tensor
    """Values [rows] by which the splats of a tile are sorted: z, or distance from the camera."""
    rest: tuple[Tensor, ...]
    """Further results of `StepOperations.rasterize_to_pixels`, after image and alphas."""


Projection = DenseProjection | PackedProjection
Coloring = Callable[[Any], tuple[Tensor, Projection]]
"""Function from a projection to the colours [..., C, N, D] or [rows, D] of its splats, and to the projection without the
splats whose colours are not finite.
"""


class ColoredSplats(NamedTuple):
    """Projected splats before tiles and blending; rows as in `RenderedSplats`."""

    rows: Projection
    channels: Tensor
    opacities: Tensor
    nearness: Tensor


Recoloring = Callable[[ColoredSplats, Tensor, Tensor], Tensor]
"""Function that returns the channels to blend in place of those of the given splats, whose tile lists are `isect_offsets` and
`flatten_ids`.
"""


def render_splats(
    ops: StepOperations,
    geometry: Geometry,
    coloring: Coloring | None,
    backgrounds: Tensor | None,
    settings: RenderSettings,
    recoloring: Recoloring | None = None,
) -> RenderedSplats:
    """Project, colour, bin into tiles and blend; shapes must have been checked.

    Without `coloring` only depth is rendered.
    """
    splats = project_splats(ops, geometry, coloring, settings)
    return blend_splats(ops, splats, backgrounds, settings, geometry.viewmats.shape[:-2], recoloring)


def project_splats(
    ops: StepOperations, geometry: Geometry, coloring: Coloring | None, settings: RenderSettings
) -> ColoredSplats:
    """Project the Gaussians, with the colours of `coloring`; without it the only channel is the depth."""
    means, covars, quats, scales, opacities, viewmats, Ks = geometry
    compensation_floor = CONSTANTS[settings.constants].compensation_floor
    batch_dims, n_gaussians, n_cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    rows: Projection = ops.fully_fused_projection(
        means, covars, quats, scales, viewmats, Ks, settings.width, settings.height,
        eps2d=settings.eps2d, near_plane=settings.near_plane, far_plane=settings.far_plane,
        radius_clip=settings.radius_clip, calc_compensations=settings.rasterize_mode == "antialiased",
        camera_model=settings.camera_model, opacities=opacities, compensation_floor=compensation_floor,
        packed=settings.packed, sparse_grad=bool(settings.sparse_grad),
    )  # fmt: skip
    channels = None
    if coloring is not None:
        channels, rows = coloring(rows)
    picked = None
    if isinstance(rows, PackedProjection):
        pairs = Pairs(math.prod(batch_dims), n_cameras, n_gaussians)
        picked = pairs.ids_of(rows)
        assert ops.values_of_rows is not None
        opacities = ops.values_of_rows(opacities, picked, pairs, len(batch_dims), settings.sparse_grad == "all")
    else:
        opacities = opacities[..., None, :].expand(*batch_dims, n_cameras, n_gaussians)
    if rows.compensations is not None:
        opacities = opacities * rows.compensations
    if settings.has_depth or channels is None:
        depth = rows.depths[..., None]
        channels = depth if channels is None else torch.cat([channels, depth], -1)
    nearness = rows.depths
    if not settings.global_z_order:
        nearness = _distances_of_centres(means.detach(), viewmats.detach())
        nearness = nearness if picked is None else nearness.reshape(-1)[picked]
    return ColoredSplats(rows, channels, opacities, nearness)


def blend_splats(
    ops: StepOperations,
    splats: ColoredSplats,
    backgrounds: Tensor | None,
    settings: RenderSettings,
    image_dims: Sequence[int],
    recoloring: Recoloring | None = None,
) -> RenderedSplats:
    """Bin splats into the tiles of pictures [..., C] and blend them, with other channels if `recoloring` is given."""
    rows, channels, opacities, nearness = splats
    packing: dict[str, Any] = {}
    if isinstance(rows, PackedProjection):
        image_ids = rows.batch_ids * image_dims[-1] + rows.camera_ids
        packing = {"packed": True, "n_images": math.prod(image_dims), "image_ids": image_ids}
    if backgrounds is not None:
        # Depth and further signals have no background.
        backgrounds = pad(backgrounds, (0, channels.shape[-1] - backgrounds.shape[-1])) if settings.has_colors else None
    grid = TileGrid(settings.tile_size, *settings.tile_grid)
    tiles_per_gauss, flatten_ids, isect_offsets = ops.bin_splats(
        rows.means2d, rows.radii, nearness, grid, conics=rows.conics, opacities=opacities, **packing
    )
    isect_offsets = isect_offsets.reshape(*image_dims, *reversed(settings.tile_grid))
    if recoloring is not None:
        channels = recoloring(splats, isect_offsets, flatten_ids)
    image, alphas, *rest = ops.rasterize_to_pixels(
        rows.means2d, rows.conics, channels, opacities, settings.width, settings.height, settings.tile_size, isect_offsets,
        flatten_ids, backgrounds=backgrounds, packed=bool(packing), absgrad=settings.absgrad,
        max_alpha=CONSTANTS[settings.constants].max_alpha,
    )  # fmt: skip
    return RenderedSplats(
        image, alphas, rows, channels, opacities, tiles_per_gauss, flatten_ids, isect_offsets, nearness, tuple(rest)
    )


def _distances_of_centres(means: Tensor, viewmats: Tensor) -> Tensor:
    """Return the distances [..., C, N] of the Gaussians' centres from the camera centres."""
    local = means[..., None, :, :] @ viewmats[..., :3, :3].mT + viewmats[..., None, :3, 3]
    return torch.linalg.vector_norm(local, dim=-1)


def isect_ids_of(flatten_ids: Tensor, isect_offsets: Tensor, depths: Tensor, tiles_of_image: int) -> Tensor:
    """Return gsplat's int64 key of each tile-list entry: image | tile | 32 bits of float32 depth."""
    starts, length = isect_offsets.reshape(-1), flatten_ids.shape[0]
    counts = torch.diff(starts, append=starts.new_full((1,), length))
    tiles = torch.arange(len(starts), device=starts.device)
    images = torch.div(tiles, tiles_of_image, rounding_mode="floor")
    keys = (images << (32 + tiles_of_image.bit_length())) | ((tiles - images * tiles_of_image) << 32)
    bits = depths.detach().float().reshape(-1).view(torch.int32)[flatten_ids].long() & 0xFFFFFFFF
    return torch.repeat_interleave(keys, counts, output_size=length) | bits


class Signal(NamedTuple):
    """Values of Gaussians to blend: plain [..., (C,) N, D], or spherical harmonics [..., (C,) N, K, D]."""

    values: Tensor
    degree: int | None
    """Degree of the spherical harmonics; None for plain values."""
    clamped: bool = True
    """True to clamp evaluated harmonics to 0 or more; False to keep negative values."""

    def seen(self, ops: StepOperations, means: Tensor, viewmats: Tensor, visible: Tensor) -> Tensor:
        """Return the values [..., C, N, D] seen by each camera, before shift and clamp."""
        per_camera = self.values.dim() - (1 if self.degree is None else 2) == visible.dim()
        if self.degree is None:
            values = self.values if per_camera else self.values[..., None, :, :]
            return values.expand(*visible.shape, values.shape[-1])
        directions = means[..., None, :, :] - camera_centers(viewmats)[..., None, :]
        # The extra dimension is broadcast by the op, which saves one copy of the coefficients per camera.
        coefficients = self.values if per_camera or means.dim() == 2 else self.values[..., None, :, :, :]
        width = coefficients.shape[-1]
        if width == 3:
            return ops.spherical_harmonics(self.degree, directions, coefficients, masks=visible)
        triples = pad(coefficients, (0, -width % 3)).split(3, -1)
        parts = [ops.spherical_harmonics(self.degree, directions, triple, masks=visible) for triple in triples]
        return torch.cat(parts, -1)[..., :width]

    def of_rows(
        self, ops: StepOperations, ids: Tensor, pairs: Pairs, directions: Tensor, batch_dims: int, sparse: bool
    ) -> Tensor:
        """Return the values [rows, D] of the packed rows (visible pairs of camera and Gaussian), before shift and clamp."""
        assert ops.values_of_rows is not None and ops.visible_harmonics is not None
        per_camera = self.values.dim() - (1 if self.degree is None else 2) == batch_dims + 2
        if per_camera:
            pairs, batch_dims, sparse = Pairs(pairs.batches * pairs.cameras, 1, pairs.gaussians), batch_dims + 1, False
        if self.degree is None:
            return ops.values_of_rows(self.values, ids, pairs, batch_dims, sparse)
        width = self.values.shape[-1]
        triples = [self.values] if width == 3 else pad(self.values, (0, -width % 3)).split(3, -1)
        parts = [
            ops.visible_harmonics(self.degree, directions, each, ids, pairs, batch_dims, sparse and width == 3)
            for each in triples
        ]
        return parts[0] if width == 3 else torch.cat(parts, -1)[..., :width]

    def shown(self, values: Tensor) -> Tensor:
        """Return seen values shifted and clamped as in 3DGS; plain values are unchanged."""
        if self.degree is None:
            return values
        return (values + 0.5).clamp_min(0) if self.clamped else values + 0.5


Dense = TypeVar("Dense", DenseProjection, DenseSurfels)


def view_colors(
    ops: StepOperations, means: Tensor, signals: Sequence[Signal], viewmats: Tensor, dense: Dense
) -> tuple[Tensor, Dense]:
    """Return the channels [..., C, N, D] of all signals seen by each camera, and the projection in which Gaussians with
    non-finite channels are culled.

    On CUDA the host does not synchronise, so colours of culled Gaussians are not replaced. They have no effect: culled
    Gaussians are in no tile list, compositing skips non-finite values, and a zero colour gradient adds nothing to the
    coefficients' gradient.
    """
    visible = dense.radii[..., 0] > 0

    def evaluate(visible: Tensor) -> Tensor:
        parts = [signal.seen(ops, means, viewmats, visible) for signal in signals]
        return parts[0] if len(parts) == 1 else torch.cat(parts, -1)

    # Check before clamping, which would turn minus infinity into black.
    values = evaluate(visible)
    if values.is_cuda and ops.zero_gradients_stay_zero:
        finite = (values.detach() * 0).sum(-1) == 0  # 0 times a number is 0, unless it is a NaN or an infinity
        return _shown(signals, values), dense._replace(radii=dense.radii * finite.to(dense.radii.dtype)[..., None])
    # In the common case one sum suffices, because a sum is non-finite if any of its terms is. A compiled graph cannot
    # branch on a value and always tests every colour.
    if torch.compiler.is_compiling() or not torch.isfinite(values.detach().sum()):
        finite = values.detach().isfinite().all(-1)
        visible = visible & finite
        values = torch.where(visible[..., None], evaluate(visible), torch.zeros_like(values))
        keep = visible.to(dense.radii.dtype)
        dense = dense._replace(radii=dense.radii * keep[..., None])
    return _shown(signals, values), dense


def row_colors(
    ops: StepOperations,
    means: Tensor,
    signals: Sequence[Signal],
    viewmats: Tensor,
    rows: PackedProjection,
    sparse_grad: SparseGradients,
) -> tuple[Tensor, PackedProjection]:
    """Return the channels [rows, D] of all signals, and the projection `rows`; rows with non-finite channels are left out."""
    batch_dims, n_cameras = means.dim() - 2, viewmats.shape[-3]
    pairs = Pairs(math.prod(means.shape[:-2]), n_cameras, means.shape[-2])

    def evaluate(rows: PackedProjection) -> Tensor:
        ids, directions = pairs.ids_of(rows), rows.means2d.new_zeros(())
        if any(signal.degree is not None for signal in signals):
            assert ops.values_of_rows is not None
            positions = ops.values_of_rows(means, ids, pairs, batch_dims, bool(sparse_grad))
            images = rows.batch_ids * n_cameras + rows.camera_ids
            directions = positions - _centers_of_rows(viewmats, images)
        parts = [signal.of_rows(ops, ids, pairs, directions, batch_dims, sparse_grad == "all") for signal in signals]
        return parts[0] if len(parts) == 1 else torch.cat(parts, -1)

    values = evaluate(rows)
    if not torch.isfinite(values.detach().sum()):
        finite = values.detach().isfinite().all(-1).nonzero()[:, 0]
        if len(finite) < len(values):
            rows = PackedProjection(*(None if each is None else each[finite] for each in rows))  # type: ignore[arg-type]
            values = evaluate(rows)
    return _shown(signals, values), rows


def _centers_of_rows(viewmats: Tensor, images: Tensor) -> Tensor:
    """Return the camera centre of each row, [rows, 3]; gradients are summed in a fixed order."""
    centers = camera_centers(viewmats).reshape(-1, 3)
    if len(centers) > 1 and not centers.requires_grad:
        return centers[images]
    counts = [len(images)] if len(centers) == 1 else torch.bincount(images, minlength=len(centers)).tolist()
    parts = [center.expand(count, 3) for center, count in zip(centers, counts, strict=True)]
    return torch.cat(parts) if parts else centers


def _shown(signals: Sequence[Signal], values: Tensor) -> Tensor:
    if len(signals) == 1:
        return signals[0].shown(values)
    parts = values.split([signal.values.shape[-1] for signal in signals], -1)
    return torch.cat([signal.shown(part) for signal, part in zip(signals, parts, strict=True)], -1)


def camera_centers(viewmats: Tensor) -> Tensor:
    """Return the camera centres [..., 3] of world-to-camera matrices [..., 4, 4].

    This is the translation column of the inverse of any invertible matrix. On CUDA it is computed by Cramer's rule,
    because `torch.linalg.inv` synchronises with the host to check invertibility. The centre is the vector orthogonal to
    the first three rows, scaled so that its product with the fourth row is 1.
    """
    if not viewmats.is_cuda:
        return torch.linalg.inv(viewmats)[..., :3, 3]
    rows, shifts = viewmats[..., :3, :3], viewmats[..., :3, 3]
    crosses = torch.linalg.cross(rows.roll(-1, -2), rows.roll(-2, -2))
    center = -(shifts[..., None] * crosses).sum(-2)
    determinant = (rows[..., 0, :] * crosses[..., 0, :]).sum(-1, keepdim=True)
    last = viewmats[..., 3, :]
    return center / ((last[..., :3] * center).sum(-1, keepdim=True) + last[..., 3:] * determinant)


Meta = dict[str, Any]
"""Third result of `rasterization`: intermediate results under gsplat's names."""


MOST_CHECKED_CALLS = 256
"""Largest number of call signatures whose checks are remembered. Each number of Gaussians has another signature."""


class CheckedCall(NamedTuple):
    """Result of checking the arguments of a call of `rasterization`; reused for later calls of the same signature."""

    settings: RenderSettings
    native: SingleCall | None
    """Native call for the whole pipeline; None to render step by step."""


@dataclass(frozen=True)
class Operations(StepOperations):
    """Implementation of the pipeline's operations, with `rasterization` built on top of them."""

    single_call: Callable[[Arguments, RenderSettings], SingleCall | None] | None = None
    """Function that returns a native call for the whole pipeline, or None for unsupported arguments."""
    checked: dict[Hashable, CheckedCall] = field(init=False, default_factory=dict, compare=False, repr=False)
    """Results of the checks of earlier calls of `rasterization`, by the key that `signature_of` returns."""

    def rasterization(
        self,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        opacities: Tensor,
        colors: Tensor | None,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        near_plane: float = NEAR_PLANE,
        far_plane: float = FAR_PLANE,
        radius_clip: float = 0.0,
        eps2d: float = EPS2D,
        sh_degree: int | None = None,
        packed: bool = True,
        tile_size: int | None = TILE_SIZE,
        backgrounds: Tensor | None = None,
        render_mode: RenderMode = "RGB",
        sparse_grad: SparseGradients = False,
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
        *,
        return_normals: bool = False,
        global_z_order: bool = True,
        rays: Tensor | None = None,
        ut_params: Any = None,
        lidar_coeffs: Any = None,
        external_distortion_coeffs: Any = None,
        extra_signals: Tensor | None = None,
        extra_signals_sh_degree: int | None = None,
        renderer_config: Any = None,
        constants: GsplatVersion = "1.6",
    ) -> tuple[Tensor, Tensor, Meta]:
        """Render 3D Gaussians (Kerbl et al. 2023) with gsplat 1.5.3's arguments, in its order, and its results.

        Arguments of gsplat 1.6 that 1.5.3 does not have are given by name.

        Shapes, where `...` are any batch dimensions, common to all arguments:
            means [..., N, 3]; quats [..., N, 4] wxyz, of any length from 1e-18 to 1e18; scales [..., N, 3]; opacities [..., N];
            colors [..., N, D] or [..., C, N, D] when `sh_degree` is None, else coefficients [..., N, K, 3] or
            [..., C, N, K, 3] with K >= (sh_degree + 1)², displayed as max(0, 0.5 + sum). None if `render_mode` has no RGB; D may
            be 0 if it has depth;
            viewmats [..., C, 4, 4] world to camera, OpenCV axes; Ks [..., C, 3, 3] in pixels.

        Args:
            width, height: image size in pixels; the first pixel's centre is at (0.5, 0.5). Floating-point tensors are
                truncated.
            near_plane, far_plane: range of z in the scene's unit; Gaussians with a centre outside it are culled.
            radius_clip: Gaussians with both radii at or below this many pixels are culled.
            eps2d: blur in pixels² added to the diagonal of the 2D covariance.
            packed: `meta` and the memory hold one row per visible Gaussian and camera; the image is the same.
            sparse_grad: gradients of means, quats and scales are COO tensors [N, ...] with the visible rows only, for
                optimisers such as `torch.optim.SparseAdam`. "all": those of opacities and colors, too. Needs packed, quats
                and scales, and no batch dimensions.
            tile_size: side of the square tiles in pixels; None = 16.
            backgrounds: [..., C, D], blended behind the colours; the depth channel has background 0.
            render_mode: "RGB", "D" (depth z of the centres, weighted by alpha), "ED" (divided by alpha), "RGB+D" or "RGB+ED"
                (depth is the last channel). "d", "Ed", "RGB-d" and "RGB-Ed" have the distance along the pixel's ray from the
                camera to the highest density of each Gaussian in place of z. They need quats, scales and tiles of 16 px.
                With a fisheye camera it is the distance to the Gaussian's centre. Not with with_eval3d.
            absgrad: after backward, `meta["means2d"].absgrad` holds the sum of absolute gradients (Ye et al. 2024).
            rasterize_mode: "antialiased" scales the opacity by sqrt(det Σ / det (Σ + blur)) (Yu et al. 2024).
            camera_model: "pinhole", "ortho" or "fisheye" (equidistant).
            covars: [..., N, 3, 3] in place of quats and scales.
            constants: gsplat version whose constants are used. "1.6" limits alpha to at most 0.99, and the factor of
                "antialiased" to at least 0.005. "1.5.3" limits them to 0.999 and 0. A value at its limit has no gradient.
                All other constants are equal.
            return_normals: `meta["normals"]` [..., C, H, W, 3] holds the sum of weight times shortest axis of the Gaussians in
                world axes, towards the camera. Needs quats, scales and tiles of 16 px. Not with with_eval3d.
            global_z_order: False blends the splats of a tile in the order of the distance of their centre, not of its z.
            extra_signals: further values [..., (C,) N, E], blended with the weights of the colours into
                `meta["render_extra_signals"]` [..., C, H, W, E]; or [..., (C,) N, K, E] with `extra_signals_sh_degree`, blended
                as 0.5 + sum. Their background is 0.
            with_ut: project by the unscented transform; needs quats and scales, and `meta` is not packed. `camera_model` may
                then be "ftheta", too.
            with_eval3d: blend by the response of the Gaussians along each pixel's ray.
            radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs, ut_params: lens
                and shutter for `with_ut`, as in `fully_fused_projection_with_ut`.
            distributed: the Gaussians are shared out over the processes of `torch.distributed`, and each process renders its
                own cameras, as described in `gsplat_core.rendering.distributed`. `meta` describes this process's Gaussians as
                seen by the cameras of all processes.
            channel_chunk, segmented, renderer_config: accepted for compatibility with gsplat; without effect. Colours may
                have any number of channels.

        On CUDA, one native call per pass renders pictures with tiles of 16 px, the constants of 1.6, and spherical harmonics
        or at most 3 plain colour channels. Other arguments, such as `extra_signals` and `sparse_grad`, use the chain of
        operations. In both cases the host waits once, for
        the length of the tile lists.

        Returns:
            render_colors [..., C, H, W, X], render_alphas [..., C, H, W, 1] and `meta`, a dict with batch_ids, camera_ids and
            gaussian_ids (None unless packed), radii, means2d (call retain_grad() on it to see its gradient), depths,
            conics, opacities, tile_width, tile_height, tiles_per_gauss, isect_ids, flatten_ids, isect_offsets, width,
            height, tile_size, n_batches and n_cameras. On CUDA flatten_ids and isect_ids may be views of larger memory.

        A Gaussian with a NaN or an infinity in any input, or a rotation of length zero, is culled. It has radii 0,
        gets zero gradients and does not affect other Gaussians.

        Raises:
            InvalidInput: if a shape, dtype, device or mode does not fit; the message states the observed value.
            NotImplementedError: if an argument of gsplat is not supported; the message states its value.
        """
        arguments = Arguments(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars, extra_signals)
        unscented = (with_ut, with_eval3d, ut_params, radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs,
                     rolling_shutter, viewmats_rs)  # fmt: skip
        options = (
            width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree, packed, tile_size, render_mode, sparse_grad,
            absgrad, rasterize_mode, distributed, camera_model, return_normals, global_z_order, extra_signals_sh_degree,
            constants, rays, lidar_coeffs, external_distortion_coeffs, *unscented,
        )  # fmt: skip
        ops = self
        signature = signature_of(arguments, options)
        call = None if signature is None else self.checked.get(signature)
        if call is None:
            refuse_unsupported(
                rays=rays, lidar_coeffs=lidar_coeffs, external_distortion_coeffs=external_distortion_coeffs
            )
            settings = RenderSettings(
                width=width, height=height, near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d,
                sh_degree=sh_degree, packed=packed, tile_size=TILE_SIZE if tile_size is None else tile_size,
                render_mode=render_mode, absgrad=absgrad, rasterize_mode=rasterize_mode, camera_model=camera_model,
                constants=constants, global_z_order=bool(global_z_order), extra_degree=extra_signals_sh_degree,
                normals=bool(return_normals), sparse_grad=sparse_grad, distributed=bool(distributed),
            )  # fmt: skip
            check_tensors(arguments, settings.has_colors)
            if any(value is not None and value is not False for value in unscented):
                from gsplat_core.rendering.unscented import UnscentedCamera, with_unscented_camera

                camera = UnscentedCamera(*unscented)
                if camera.given and distributed:
                    raise NotImplementedError(
                        "distributed=True is not supported with with_ut and with_eval3d; leave one of them out"
                    )
                if camera.given:
                    ops, arguments, settings = with_unscented_camera(self, camera, arguments, settings)
                    signature = None
            call = ops._chosen(signature, arguments, settings)
        settings = call.settings
        if call.native is not None:
            return _named_as_in_gsplat(call.native(arguments), arguments, settings)
        image, splats, extra, normals = _step_by_step(ops, arguments, settings)
        ids = splats.rows[:3] if isinstance(splats.rows, PackedProjection) else (None, None, None)
        keys = isect_ids_of(splats.flatten_ids, splats.isect_offsets, splats.nearness, math.prod(settings.tile_grid))
        meta = _meta(splats, splats.rows, ids, splats.opacities, keys, settings, viewmats.shape[:-2])
        for name, values in (("render_extra_signals", extra), ("normals", normals)):
            if values is not None:
                meta[name] = values
        return image, splats.alphas, meta

    def pictures(self, arguments: Arguments, settings: RenderSettings) -> tuple[Tensor, Tensor]:
        """Return colours and alphas as `rasterization`, without values that only `meta` needs."""
        signature = signature_of(arguments, tuple(vars(settings).values()))
        call = None if signature is None else self.checked.get(signature)
        if call is None:
            call = self._chosen(signature, arguments, settings)
        if call.native is not None:
            rendered = call.native(arguments)
            return rendered.image, rendered.alphas
        image, splats, *_ = _step_by_step(self, arguments, settings)
        return image, splats.alphas

    def _chosen(self, signature: Hashable | None, arguments: Arguments, settings: RenderSettings) -> CheckedCall:
        """Choose between a native call and the chain of operations; remember the choice if there is a signature."""
        call = CheckedCall(settings, None if self.single_call is None else self.single_call(arguments, settings))
        if signature is not None:
            if len(self.checked) >= MOST_CHECKED_CALLS:
                self.checked.clear()
            self.checked[signature] = call
        return call


def _named_as_in_gsplat(out: Rasterized, arguments: Arguments, settings: RenderSettings) -> tuple[Tensor, Tensor, Meta]:
    opacities, dims = out.opacities, arguments.viewmats.shape[:-2]
    if not settings.packed and settings.rasterize_mode == "classic":
        opacities = arguments.opacities.unsqueeze(-2)
        if dims[-1] != 1:
            opacities = opacities.expand(*dims, -1)
    meta = _meta(out, out, (out.batch_ids, out.camera_ids, out.gaussian_ids), opacities, out.isect_ids, settings, dims)
    return out.image, out.alphas, meta


class Stepped(NamedTuple):
    """Pictures of one call by the chain of operations, and the splats blended in them."""

    image: Tensor
    """Colours and depth [..., C, H, W, X]."""
    splats: RenderedSplats
    extra: Tensor | None
    """Images of `extra_signals`, blended like colours; None without `extra_signals`."""
    normals: Tensor | None


def _step_by_step(ops: StepOperations, arguments: Arguments, settings: RenderSettings) -> Stepped:
    means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars, extra_signals = arguments
    batch_dims, n_gaussians = check_shapes(arguments, settings)
    if settings.distributed:
        from gsplat_core.rendering.distributed import all_cameras, check_distributed, exchanged

        check_distributed(arguments, settings)
    if covars is not None:
        if settings.sparse_grad:
            raise InvalidInput("sparse_grad needs quats and scales, got covars; their gradient is dense")
        require_shape("covars", covars, (*batch_dims, n_gaussians, 3, 3), "[..., N, 3, 3]")
        # Indexing with lists would synchronise on CUDA.
        covars = torch.stack([covars[..., i, j] for i in range(3) for j in range(i, 3)], -1)
        quats = scales = None
    signals = []
    colored_channels = 0
    if colors is not None and settings.shows(colors):
        signals.append(Signal(colors, settings.sh_degree))
        colored_channels = colors.shape[-1]
    if extra_signals is not None:
        signals.append(Signal(extra_signals, settings.extra_degree, clamped=False))

    def coloring(rows: Projection) -> tuple[Tensor, Projection]:
        if isinstance(rows, PackedProjection):
            return row_colors(ops, means, signals, viewmats, rows, settings.sparse_grad)
        return view_colors(ops, means, signals, viewmats, rows)

    if settings.distributed:
        viewmats, Ks = all_cameras(viewmats, Ks)
    geometry = Geometry(means, covars, quats, scales, opacities, viewmats, Ks)
    mine = project_splats(ops, geometry, coloring if signals else None, settings)
    image_dims = arguments.viewmats.shape[:-2]
    to_blend = exchanged(mine, image_dims[-1]) if settings.distributed else mine
    splats = blend_splats(ops, to_blend, backgrounds, settings, image_dims)
    if settings.distributed:  # `meta` describes the Gaussians of this process
        splats = splats._replace(rows=mine.rows, opacities=mine.opacities)
    widths = [signal.values.shape[-1] for signal in signals]
    colored = splats.image[..., :colored_channels]
    extra = None if extra_signals is None else splats.image[..., sum(widths) - widths[-1] : sum(widths)]
    depth = splats.image[..., -1:] if settings.has_depth else None
    normals = None
    if settings.has_distance or settings.normals:
        distance, normals = blended_along_rays(ops, geometry, splats, settings)
        depth = distance[..., None] if settings.has_distance else depth
    if depth is None:
        image = splats.image if extra is None else colored
    else:
        if settings.divides_depth:
            depth = depth / splats.alphas.clamp(min=1e-10)
        image = torch.cat([colored, depth], -1) if settings.has_colors else depth
    return Stepped(image, splats, extra, normals if settings.normals else None)


def blended_along_rays(
    ops: StepOperations, geometry: Geometry, splats: RenderedSplats, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Blend the distance [..., C, H, W] along the rays and the normals [..., C, H, W, 3] in world axes.

    With several pictures the host reads where their tile lists start.
    """
    means, covars, quats, scales, _, viewmats, Ks = geometry
    wanted = f"render_mode {settings.render_mode!r}" if settings.has_distance else "return_normals"
    if covars is not None or quats is None or scales is None or settings.tile_size != TILE_SIZE:
        raise InvalidInput(
            f"{wanted} needs quats and scales, and tile_size {TILE_SIZE}; got covars or another tile_size"
        )
    if viewmats.requires_grad or Ks.requires_grad:
        raise InvalidInput(
            f"{wanted} has no gradient with respect to viewmats and Ks; detach them, or use depth z ('D')"
        )
    assert ops.splat_rays is not None and ops.blend_rays is not None
    n, dims = means.shape[-2], viewmats.shape[:-2]
    images, tiles = math.prod(dims), math.prod(settings.tile_grid)
    starts = splats.isect_offsets.reshape(images, tiles)
    length = splats.flatten_ids.shape[0]
    bounds = [0, length] if images == 1 else [*starts[:, 0].tolist(), length]
    rows, first_rows = splats.rows, [0, n]
    ids = None
    if isinstance(rows, PackedProjection):
        ids = rows.gaussian_ids
        of_image = rows.batch_ids * dims[-1] + rows.camera_ids
        counts = [len(ids)] if images == 1 else torch.bincount(of_image.long(), minlength=images).tolist()
        first_rows = [0, *itertools.accumulate(counts)]
    else:
        first_rows = [n * image for image in range(images + 1)]
    # With the number of rows, because -1 is ambiguous for no Gaussians.
    flat = lambda values, trailing: values.reshape(
        math.prod(values.shape[: values.dim() - trailing]), *values.shape[values.dim() - trailing :]
    )
    means2d, conics, opacities = flat(rows.means2d, 1), flat(rows.conics, 1), splats.opacities.reshape(-1)
    max_alpha = CONSTANTS[settings.constants].max_alpha
    distances, normals = [], []
    for image in range(images):
        scene = image // dims[-1]
        view, K = flat(viewmats, 2)[image], flat(Ks, 2)[image]
        centres, turned = flat(means, 2)[scene], flat(quats, 2)[scene]
        # As in the covariance, the sign of a scale has no effect, and a flat Gaussian is visible.
        sizes = flat(scales, 2)[scene].abs().clamp(min=torch.finfo(scales.dtype).tiny)
        rays, axes = ops.splat_rays(centres, turned, sizes, view, K, settings.camera_model)
        if settings.camera_model == "fisheye":
            local = centres @ view[:3, :3].T + view[:3, 3]
            rays = torch.cat([torch.linalg.vector_norm(local, dim=-1, keepdim=True), rays[:, 1:]], 1)
        axes = axes @ view[:3, :3]
        mine = slice(first_rows[image], first_rows[image + 1])
        if ids is not None:
            picked = ids[mine].long()
            rays, axes = rays[picked], axes[picked]
        listed = splats.flatten_ids[bounds[image] : bounds[image + 1]] - first_rows[image]
        values, alphas, mean, *_ = ops.blend_rays(
            means2d[mine], conics[mine], opacities[mine], rays, axes, settings.width, settings.height,
            (starts[image] - bounds[image]).reshape(*reversed(settings.tile_grid)), listed, max_alpha=max_alpha,
        )  # fmt: skip
        distances.append(mean * alphas * _length_of_rays(K, settings, mean))
        normals.append(values)
    size = settings.height, settings.width
    return torch.stack(distances).reshape(*dims, *size), torch.stack(normals).reshape(*dims, *size, 3)


def _length_of_rays(K: Tensor, settings: RenderSettings, like: Tensor) -> Tensor:
    """Return the length [H, W] of each pixel's ray per unit of the blended depth: above 1 off the axis of a pinhole camera,
    whose depth is z, and 1 [] for other cameras, whose depth is the length.
    """
    if settings.camera_model != "pinhole":
        return like.new_ones(())
    x = (torch.arange(settings.width, device=like.device, dtype=like.dtype) + 0.5 - K[0, 2]) / K[0, 0]
    y = (torch.arange(settings.height, device=like.device, dtype=like.dtype) + 0.5 - K[1, 2]) / K[1, 1]
    return torch.sqrt(1 + x * x + (y * y)[:, None])


def _meta(
    splats: RenderedSplats | Rasterized,
    rows: DenseProjection | PackedProjection | Rasterized,
    ids: tuple[Tensor | None, ...],
    opacities: Tensor,
    isect_ids: Tensor,
    settings: RenderSettings,
    image_dims: torch.Size,
) -> Meta:
    tile_width, tile_height = settings.tile_grid
    return {
        "batch_ids": ids[0],
        "camera_ids": ids[1],
        "gaussian_ids": ids[2],
        "radii": rows.radii,
        "means2d": rows.means2d,
        "depths": rows.depths,
        "conics": rows.conics,
        "opacities": opacities,
        "tile_width": tile_width,
        "tile_height": tile_height,
        "tiles_per_gauss": splats.tiles_per_gauss,
        "isect_ids": isect_ids,
        "flatten_ids": splats.flatten_ids,
        "isect_offsets": splats.isect_offsets,
        "width": settings.width,
        "height": settings.height,
        "tile_size": settings.tile_size,
        "n_batches": math.prod(image_dims[:-1]),
        "n_cameras": image_dims[-1],
    }


def check_shapes(arguments: Arguments, settings: RenderSettings) -> tuple[tuple[int, ...], int]:
    """Check shapes and return the batch dimensions and number of Gaussians.

    The projection checks the remaining arguments.
    """
    means, opacities, colors, backgrounds = (
        arguments.means,
        arguments.opacities,
        arguments.colors,
        arguments.backgrounds,
    )
    viewmats, extra = arguments.viewmats, arguments.extra_signals
    if means.dim() < 2 or means.shape[-1] != 3:
        raise InvalidInput(f"means must be [..., N, 3], got {list(means.shape)}")
    if viewmats.dim() < 3:
        raise InvalidInput(f"viewmats must be [..., C, 4, 4], got {list(viewmats.shape)}")
    batch_dims, n, c = tuple(means.shape[:-2]), means.shape[-2], viewmats.shape[-3]
    require_shape("opacities", opacities, (*batch_dims, n), "[..., N]")
    for name, values, degree in (
        ("colors", colors, settings.sh_degree),
        ("extra_signals", extra, settings.extra_degree),
    ):
        if values is None:
            continue
        last = "D" if name == "colors" and degree is None else "3" if name == "colors" else "E"
        form = f"[..., (C,) N, {last}]" if degree is None else f"[..., (C,) N, K, {last}]"
        leading = tuple(values.shape[: values.dim() - (1 if degree is None else 2)])
        if leading not in ((*batch_dims, n), (*batch_dims, c, n)):
            raise InvalidInput(f"{name} must be {form} with N = {n}, C = {c}, got {list(values.shape)}")
        if degree is None and values.shape[-1] < (settings.least_colors if name == "colors" else 1):
            raise InvalidInput(f"{name} must be {form} with at least one channel, got {list(values.shape)}")
    require_same_kind(means=means, colors=colors, backgrounds=backgrounds, extra_signals=extra)
    if backgrounds is not None and colors is not None:
        depth_only = not settings.has_colors
        d = backgrounds.shape[-1] if depth_only else 3 if settings.sh_degree is not None else colors.shape[-1]
        require_shape("backgrounds", backgrounds, (*batch_dims, c, d), "[..., C, D]")
    return batch_dims, n
