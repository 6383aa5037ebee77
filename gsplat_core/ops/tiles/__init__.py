"""Binning of splats into tiles, with each tile's splats sorted by depth (Kerbl et al. 2023)."""

from __future__ import annotations

import math
from typing import Any, overload

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.ops.arguments import TileGrid


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
    """List the tiles that each splat touches, sorted by image, tile and depth (Kerbl et al. 2023).

    Names and results are those of gsplat 1.5.3.

    Args:
        means2d: float32 [..., N, 2] pixels, `...` being the images. Packed: [nnz, 2].
        radii: int32 [..., N, 2] pixels; a splat with a zero radius is culled. Packed: [nnz, 2].
        depths: float32 [..., N]. Packed: [nnz].
        tile_size: side of a tile in pixels.
        tile_width: tiles per row.
        tile_height: tiles per column.
        sort: sort by image, tile and depth (ties by index); otherwise the order is by splat.
        segmented: accepted for compatibility with gsplat; the result is the same.
        packed: splats are packed rows; requires n_images and image_ids.
        n_images: number of images of packed splats.
        image_ids: image [nnz] of each packed splat.
        gaussian_ids: accepted for compatibility with gsplat; not used.
        conics: [..., N, 3]. With opacities, only tiles in which alpha reaches 1/255 within the rectangle of pixel
            centres are listed. Otherwise all tiles of the box mean ± radius are listed, as in gsplat.
        opacities: [..., N].

    Returns:
        tiles_per_gauss int32 [..., N], isect_ids int64 [M] (image | tile | 32 bits of depth), and
            flatten_ids int32 [M] (index into the flattened [..., N], or into nnz).

    Raises:
        InvalidInput: for wrong shapes or dtypes.
    """
    images, chosen = _check(means2d, radii, depths, packed, n_images, image_ids, conics, opacities)
    tiles_per_gauss, isect_ids, flatten_ids = torch.ops.gsplat_core.isect_tiles(
        *_flat(means2d, radii, depths, conics, opacities), chosen, images, tile_size, tile_width, tile_height, sort
    )
    return tiles_per_gauss.reshape(depths.shape), isect_ids, flatten_ids


@overload
def bin_splats(
    means2d: Tensor, radii: Tensor, depths: Tensor, grid: TileGrid,
    packed: bool = ..., n_images: int | None = ..., image_ids: Tensor | None = ...,
    *, conics: Tensor | None = ..., opacities: Tensor | None = ..., capacity: None = ...,
) -> tuple[Tensor, Tensor, Tensor]: ...  # fmt: skip


@overload
def bin_splats(
    means2d: Tensor, radii: Tensor, depths: Tensor, grid: TileGrid,
    packed: bool = ..., n_images: int | None = ..., image_ids: Tensor | None = ...,
    *, conics: Tensor | None = ..., opacities: Tensor | None = ..., capacity: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]: ...  # fmt: skip


def bin_splats(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    grid: TileGrid,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    *,
    conics: Tensor | None = None,
    opacities: Tensor | None = None,
    capacity: int | None = None,
) -> tuple[Tensor, Tensor, Tensor] | tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bin splats into tiles: `isect_tiles` (sorted) and `isect_offset_encode` without 64-bit ids.

    The tensors and remaining options are those of `isect_tiles`.

    Args:
        grid: tiles of the image.
        capacity: length of the lists, 0 to 2^31 - 1. None makes them exactly as long as needed, for which the host
            synchronises on CUDA. A number fixes the length on any device without synchronisation, so a CUDA graph can
            capture the call. Unused entries are -1 and precede the first tile's list, so no offset refers to them. If
            `needed` exceeds the capacity, the lists contain the nearest splats of all images whose tiles fit
            completely, and the caller must repeat the call with a larger capacity.

    Returns:
        tiles_per_gauss int32 [..., N], flatten_ids int32 [M] or [capacity], and isect_offsets int32 [..., tile_height,
        tile_width]. With a capacity also `needed`, int64 [1] on the splats' device: the total number of entries.
        Compositing accepts both kinds of lists.

    Raises:
        InvalidInput: for wrong shapes, dtypes, devices or capacity.
    """
    images, chosen = _check(means2d, radii, depths, packed, n_images, image_ids, conics, opacities)
    splats = (*_flat(means2d, radii, depths, conics, opacities), chosen)
    ops = torch.ops.gsplat_core
    if capacity is None:
        tiles_per_gauss, flatten_ids, offsets = ops.bin_splats(*splats, images, *grid)
        needed = None
    else:
        if not 0 <= capacity < 2**31:
            raise InvalidInput(f"capacity must be 0 to 2^31 - 1 entries, or None for exactly as many, got {capacity}")
        tiles_per_gauss, flatten_ids, offsets, needed = ops.bin_splats_within(*splats, images, *grid, capacity)
    image_dims = (images,) if packed else depths.shape[:-1]
    lists = (
        tiles_per_gauss.reshape(depths.shape),
        flatten_ids,
        offsets.reshape(*image_dims, grid.tile_height, grid.tile_width),
    )
    return lists if needed is None else (*lists, needed)


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Return the start of each tile's entries in sorted ids.

    Args:
        isect_ids: int64 [M], sorted ids returned by `isect_tiles`.
        n_images: number of images.
        tile_width: tiles per row.
        tile_height: tiles per column.

    Returns:
        int32 [n_images, tile_height, tile_width].
    """
    return torch.ops.gsplat_core.isect_offset_encode(isect_ids, n_images, tile_width, tile_height)


def _check(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    packed: bool,
    n_images: int | None,
    image_ids: Tensor | None,
    conics: Tensor | None,
    opacities: Tensor | None,
) -> tuple[int, Tensor | None]:
    """Check the arguments; return the number of images and the image of every packed splat (None if not packed)."""
    shape = tuple(depths.shape)
    expected = {"means2d": (means2d, 2), "radii": (radii, 2)} | ({} if conics is None else {"conics": (conics, 3)})
    for name, (tensor, last) in expected.items():
        if tuple(tensor.shape) != (*shape, last):
            raise InvalidInput(
                f"{name} must have shape {(*shape, last)} to go with depths {shape}, got {tuple(tensor.shape)}"
            )
    if (conics is None) != (opacities is None):
        raise InvalidInput("the exact tile test needs both conics and opacities; give both or neither")
    if opacities is not None and tuple(opacities.shape) != shape:
        raise InvalidInput(f"opacities must have the shape of depths, {shape}, got {tuple(opacities.shape)}")
    for name, value in {"means2d": means2d, "depths": depths, "conics": conics, "opacities": opacities}.items():
        if value is not None and value.dtype != torch.float32:
            raise InvalidInput(
                f"{name} must be float32, got {value.dtype}; gsplat_core.reference.isect_tiles takes any dtype"
            )
    if radii.dtype != torch.int32:
        raise InvalidInput(f"radii must be int32 pixels, got {radii.dtype}")
    if not packed:
        if not shape:
            raise InvalidInput("depths must have shape [..., N], got a scalar")
        return math.prod(shape[:-1]), None
    if n_images is None or image_ids is None or len(shape) != 1 or image_ids.shape != depths.shape:
        raise InvalidInput("packed splats need depths [nnz], n_images and image_ids [nnz]")
    return n_images, image_ids.int()


def _flat(
    means2d: Tensor, radii: Tensor, depths: Tensor, conics: Tensor | None, opacities: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
    """Return the tensors in the order of the arguments, with all images flattened into the first dimension and detached,
    because binning has no gradient.
    """
    return (
        means2d.detach().reshape(-1, 2),
        radii.reshape(-1, 2),
        depths.detach().reshape(-1),
        None if conics is None else conics.detach().reshape(-1, 3),
        None if opacities is None else opacities.detach().reshape(-1),
    )


@torch.library.register_fake("gsplat_core::isect_tiles")
def _isect_tiles_fake(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    _, _, depths, *_ = arguments
    found = torch.library.get_ctx().new_dynamic_size()
    counts = depths.new_empty(depths.numel(), dtype=torch.int32)
    return counts, depths.new_empty(found, dtype=torch.int64), depths.new_empty(found, dtype=torch.int32)


@torch.library.register_fake("gsplat_core::bin_splats")
def _bin_splats_fake(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    _, _, depths, *_, images, _, tile_width, tile_height = arguments
    found = torch.library.get_ctx().new_dynamic_size()
    counts = depths.new_empty(depths.numel(), dtype=torch.int32)
    offsets = depths.new_empty(images, tile_height, tile_width, dtype=torch.int32)
    return counts, depths.new_empty(found, dtype=torch.int32), offsets


@torch.library.register_fake("gsplat_core::bin_splats_within")
def _bin_splats_within_fake(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    _, _, depths, *_, images, _, tile_width, tile_height, capacity = arguments
    counts = depths.new_empty(depths.numel(), dtype=torch.int32)
    offsets = depths.new_empty(images, tile_height, tile_width, dtype=torch.int32)
    lists = depths.new_empty(capacity, dtype=torch.int32)
    return counts, lists, offsets, depths.new_empty(1, dtype=torch.int64)


@torch.library.register_fake("gsplat_core::isect_offset_encode")
def _isect_offset_encode_fake(isect_ids: Tensor, images: int, tile_width: int, tile_height: int) -> Tensor:
    return isect_ids.new_empty(images, tile_height, tile_width, dtype=torch.int32)
