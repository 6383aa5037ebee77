"""Surfels (flat Gaussians) in plain torch: projection, and blending at ray intersections (Huang et al. 2024, 2D Gaussian Splatting)."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsplat_core.ops.arguments import (
    LEAST_EXTENT_SQUARED,
    MAX_EXTENT_SIGMAS,
    MAX_RADIUS_PX,
    DenseSurfels,
    PackedSurfels,
    check_surfel_arguments,
    pack_surfels,
)
from gsplat_core.reference.compositing import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP
from gsplat_core.reference.projection import quat_to_rotmat


def fully_fused_projection_2dgs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
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
) -> DenseSurfels | PackedSurfels:
    """Project surfels to the images of cameras; see `gsplat_core.fully_fused_projection_2dgs`.

    Gradients are dense, also with `sparse_grad`.
    """
    check_surfel_arguments(means, quats, scales, viewmats, Ks, width, height, packed, sparse_grad)
    # Replace unusable surfels before any arithmetic, because a masked NaN would reach the gradient.
    usable = means.isfinite().all(-1) & quats.isfinite().all(-1) & (quats != 0).any(-1) & scales.isfinite().all(-1)
    means = torch.where(usable[..., None], means, torch.zeros_like(means))
    quats = torch.where(usable[..., None], quats, quats.new_tensor([1, 0, 0, 0]))
    scales = torch.where(usable[..., None], scales, torch.ones_like(scales))
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    centers = torch.einsum("...cij,...nj->...cni", rotation, means) + translation[..., None, :]
    z = centers[..., 2]
    valid = usable[..., None, :] & (z > near_plane) & (z < far_plane)
    centers = torch.where(valid[..., None], centers, centers.new_tensor([0, 0, 1]))
    axes = torch.einsum("...cij,...njk->...cnik", rotation, quat_to_rotmat(quats))
    to_camera = torch.cat([axes[..., :2] * scales[..., None, :, None, :2], centers[..., None]], -1)

    fx, fy, cx, cy = (Ks[..., row, column, None, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y, w = to_camera.unbind(-2)
    ray_transforms = torch.stack([fx * x + cx * w, fy * y + cy * w, w], -2)

    # Bounding box of the projected ellipse u² + v² = 1. The image of the centre is its origin, for accuracy.
    image = torch.stack([fx[..., 0], fy[..., 0]], -1) * centers[..., :2] / centers[..., 2:]
    around = torch.stack([fx * x, fy * y], -2) - image[..., None] * w[..., None, :]
    signs = w.new_tensor([1, 1, -1])
    distance = (signs * w * w).sum(-1)
    valid = valid & (distance != 0)
    factors = signs / torch.where(valid, distance, torch.ones_like(distance))[..., None]
    offsets = (factors[..., None, :] * around * w[..., None, :]).sum(-1)
    means2d = image + torch.stack([cx[..., 0], cy[..., 0]], -1) + offsets
    with torch.no_grad():
        squares = offsets**2 - (factors[..., None, :] * around**2).sum(-1)
        half_sizes = (
            (MAX_EXTENT_SIGMAS * squares.clamp(min=LEAST_EXTENT_SQUARED).sqrt()).ceil().clamp(max=MAX_RADIUS_PX)
        )
        valid = valid & means2d.isfinite().all(-1) & ray_transforms.flatten(-2).isfinite().all(-1)
        valid = valid & (half_sizes > radius_clip).any(-1)
        size = means2d.new_tensor([width, height])
        valid = valid & ((means2d + half_sizes > 0) & (means2d - half_sizes < size)).all(-1)

    normals = axes[..., 2]
    facing = (normals * centers).sum(-1, keepdim=True) < 0
    zero = torch.zeros_like(z)
    dense = DenseSurfels(
        radii=torch.where(valid[..., None], half_sizes, zero[..., None]).to(torch.int32),
        means2d=torch.where(valid[..., None], means2d, zero[..., None]),
        depths=torch.where(valid, centers[..., 2], zero),
        ray_transforms=torch.where(valid[..., None, None], ray_transforms, zero[..., None, None]),
        normals=torch.where(valid[..., None], torch.where(facing, normals, -normals), zero[..., None]),
    )
    return pack_surfels(dense) if packed else dense


SCREEN_FACTOR = 2.0
"""Factor of the squared distance d from `means2d` in pixels, in sigma = min(u² + v², 2 d²) / 2. It keeps a surfel visible
that is smaller than a pixel.
"""


SURFELS_AT_A_TIME = 2048
"""Largest number of a tile's surfels that are blended together, which bounds memory."""


class _TileResult(NamedTuple):
    """Blended values of a tile's pixels [P]."""

    colors: Tensor
    alphas: Tensor
    normals: Tensor
    distortions: Tensor
    medians: Tensor


def rasterize_to_pixels_2dgs(
    means2d: Tensor,
    ray_transforms: Tensor,
    colors: Tensor,
    opacities: Tensor,
    normals: Tensor,
    densify: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
    *,
    max_alpha: float = ALPHA_MAX,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Blend surfels front to back over every pixel; see `gsplat_core.rasterize_to_pixels_2dgs`.

    Tiles are processed one by one and recomputed in the backward pass.
    """
    image_dims = isect_offsets.shape[:-2]
    tile_height, tile_width = isect_offsets.shape[-2:]
    images, channels = image_dims.numel(), colors.shape[-1]
    background = None if backgrounds is None else backgrounds.reshape(images, channels)
    transforms = _Densify.apply(ray_transforms.reshape(-1, 3, 3), densify.reshape(-1, 2))
    tiles = _Tiles(
        torch.cat([
            means2d.reshape(-1, 2), transforms.reshape(-1, 9), opacities.reshape(-1, 1), normals.reshape(-1, 3),
            colors.reshape(-1, channels),
        ], -1),
        isect_offsets, flatten_ids, masks, max_alpha,
    )  # fmt: skip
    if absgrad:
        tiles.absolute = means2d.new_zeros(means2d.numel() // 2, 2)
        means2d.absgrad = tiles.absolute.view(means2d.shape)  # type: ignore[attr-defined]
    pictures = []
    for image in range(images):
        rows = []
        for tile_y in range(tile_height):
            row = []
            for tile_x in range(tile_width):
                tile = (image * tile_height + tile_y) * tile_width + tile_x
                x = torch.arange(tile_x * tile_size, min((tile_x + 1) * tile_size, image_width), device=means2d.device)
                y = torch.arange(tile_y * tile_size, min((tile_y + 1) * tile_size, image_height), device=means2d.device)
                grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2).to(means2d.dtype) + 0.5
                result = tiles.blend(tile, grid)
                if background is not None:
                    result = result._replace(colors=result.colors + (1 - result.alphas) * background[image])
                row.append(torch.cat(result, -1).reshape(len(y), len(x), channels + 6))
            rows.append(torch.cat(row, 1))
        pictures.append(torch.cat(rows, 0))
    shape = (*image_dims, image_height, image_width)
    picture = torch.stack(pictures) if pictures else means2d.new_zeros(0, image_height, image_width, channels + 6)
    values = picture.reshape(*shape, channels + 6).split([channels, 1, 3, 1, 1], -1)
    return values[0], values[1], values[2], values[3], values[4]


class _Densify(torch.autograd.Function):
    """Identity on the ray transforms [N, 3, 3] that also passes a gradient to the densification probe [N, 2].

    The probe's gradient is that of the surfel's centre in pixels times its depth.
    """

    @staticmethod
    def forward(ctx: Any, transforms: Tensor, densify: Tensor) -> Tensor:
        ctx.save_for_backward(transforms)
        return transforms.view_as(transforms)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        (transforms,), (gradient,) = ctx.saved_tensors, gradients
        return gradient, gradient[:, :2, 2] * transforms[:, 2, 2, None]


class _Tiles:
    """Surfels in the order of the tile lists, with blending of one tile's surfels over its pixels."""

    absolute: Tensor | None = None
    """Sum over pixels of |dL/dmeans2d| [N, 2], filled in the backward pass; None if it is not requested."""

    def __init__(
        self, values: Tensor, isect_offsets: Tensor, flatten_ids: Tensor, masks: Tensor | None, max_alpha: float
    ) -> None:
        self.max_alpha = max_alpha
        starts = torch.cat([isect_offsets.flatten(), isect_offsets.new_tensor([flatten_ids.numel()])])
        sizes = starts.diff().long()
        with torch.no_grad():
            tile = torch.repeat_interleave(torch.arange(len(sizes), device=starts.device), sizes)
            used = values.isfinite().all(-1)[flatten_ids.long()]
            if masks is not None:
                used &= masks.reshape(-1)[tile]
            ids = flatten_ids.long()[used]
            counts = torch.bincount(tile[used], minlength=len(sizes)).tolist()
        # Gather and split once. Indexing per tile would cost a gradient of all surfels per tile.
        self.ids = ids.split(counts)
        self.values = values[ids].split(counts)

    def blend(self, tile: int, pixels: Tensor) -> _TileResult:
        """Blend the surfels of a tile over pixel centres [P, 2]."""
        ids, values = self.ids[tile], self.values[tile]
        none = pixels.new_zeros(len(pixels), 1)
        state = _State(none + 1, none, none, none, pixels.new_zeros(len(pixels), values.shape[1] - 12), none)
        sizes = _parts(len(ids))
        for some_ids, some in zip(ids.split(sizes), values.split(sizes), strict=True):
            if not bool((state.product > TRANSMITTANCE_STOP).any()):
                break
            if torch.is_grad_enabled() and values.requires_grad:
                state = _State(*checkpoint(self._blend_part, some_ids, some, pixels, state, use_reentrant=False))
            else:
                state = self._blend_part(some_ids, some, pixels, state)
        return _TileResult(state.sums[:, 3:], state.weight, state.sums[:, :3], state.distortion, state.median)

    def _blend_part(self, ids: Tensor, values: Tensor, pixels: Tensor, state: _State) -> _State:
        means2d, transforms, opacities = values[:, :2], values[:, 2:11].reshape(-1, 3, 3), values[:, 11]
        means = means2d[None].expand(len(pixels), -1, -1)
        if self.absolute is not None and means.requires_grad:
            absolute = self.absolute

            def add(gradient: Tensor) -> None:
                absolute.index_add_(0, ids, gradient.abs().sum(0))

            means.register_hook(add)
        alpha = (falloff(means, transforms, pixels) * opacities).clamp(max=self.max_alpha)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
        # Cumulative product of (1 - alpha) through logarithms, which has a cheaper gradient.
        after = state.product * torch.exp(torch.cumsum(torch.log1p(-alpha), 1))
        before = torch.cat([state.product, after[:, :-1]], 1)
        # The product decreases monotonically, so the blended surfels are the start of the list.
        weights = torch.where(after > TRANSMITTANCE_STOP, alpha * before, 0)
        depths = values[:, -1]
        weighted = weights * depths
        in_front = state.weight + weights.cumsum(1) - weights
        depth_in_front = state.depth + weighted.cumsum(1) - weighted
        pairs = 2 * (weighted * in_front - weights * depth_in_front)
        first_half = ((before > 0.5) & (weights > 0)).detach()
        place = (first_half * torch.arange(1, len(ids) + 1, device=ids.device)).max(1, keepdim=True).values
        median = torch.where(place > 0, depths[(place - 1).clamp(min=0)], state.median)
        return _State(
            after[:, -1:], state.weight + weights.sum(1, keepdim=True), state.depth + weighted.sum(1, keepdim=True),
            state.distortion + pairs.sum(1, keepdim=True), state.sums + weights @ values[:, 12:], median,
        )  # fmt: skip


class _State(NamedTuple):
    """State of front-to-back blending at each of a tile's P pixels, after some of the surfels; [P, 1] unless stated."""

    product: Tensor
    """Product of 1 - alpha of all surfels so far, also of those after early termination."""
    weight: Tensor
    depth: Tensor
    """Sum of weight times depth."""
    distortion: Tensor
    sums: Tensor
    """Sums of weight times normal and colours, [P, 3 + channels]."""
    median: Tensor


def _parts(count: int) -> list[int]:
    """Return the sizes of the parts in which a tile's list is blended: few surfels first, because blending may end early."""
    starts = [start for start in (0, 64, 192) if start < count] + list(range(448, count, SURFELS_AT_A_TIME))
    return [end - start for start, end in itertools.pairwise([*starts, count])]


def falloff(means2d: Tensor, transforms: Tensor, pixels: Tensor) -> Tensor:
    """Return exp(-sigma) [P, N] of surfels at pixels; 0 where a ray is parallel to the surfel.

    Args:
        means2d: [P, N, 2], equal for all pixels.
        transforms: [N, 3, 3].
        pixels: pixel centres [P, 2].
    """
    dx, dy = (pixels[:, None] - means2d).unbind(-1)
    # The cross product of px w - x and py w - y, which is linear in the pixel. Its origin is the projected centre, for
    # accuracy. The centre is a constant here.
    center = means2d[0].detach() if len(pixels) else pixels.new_zeros(len(transforms), 2)
    w = transforms[:, 2]
    x, y = transforms[:, 0] - center[:, :1] * w, transforms[:, 1] - center[:, 1:] * w
    cross = torch.linalg.cross
    across, down = dx.detach(), dy.detach()
    first, second, third = (
        a + across * b + down * c
        for a, b, c in zip(cross(x, y).unbind(-1), cross(y, w).unbind(-1), cross(w, x).unbind(-1), strict=True)
    )
    hit = third != 0
    inverse = 1 / torch.where(hit, third, 1)
    plane = (first * inverse).square() + (second * inverse).square()
    screen = SCREEN_FACTOR * (dx.square() + dy.square())
    return torch.where(hit, torch.exp(-0.5 * torch.where(plane <= screen, plane, screen)), 0)
