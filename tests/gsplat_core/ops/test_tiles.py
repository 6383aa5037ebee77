"""The compiled tile lists against plain torch."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.compositing import rasterize_to_pixels
from gsplat_core.ops.tiles import bin_splats, isect_offset_encode, isect_tiles
from gsplat_core.reference import projection as reference
from gsplat_core.reference.rendering import bin_splats_within

WIDTH, HEIGHT = 150, 100


def splats(
    count: int, image_dims: tuple[int, ...] = (1,), seed: int = 0, median_px: float = 3.0
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """means2d, radii, depths, conics, opacities of random ellipses in and around the image."""
    random = torch.Generator().manual_seed(seed)
    shape = (*image_dims, count)
    means2d = torch.rand(*shape, 2, generator=random) * torch.tensor([WIDTH + 60.0, HEIGHT + 60.0]) - 30
    axes = (
        torch.randn(*shape, 2, 2, generator=random)
        * median_px
        * torch.exp(0.7 * torch.randn(*shape, 1, 1, generator=random))
    )
    covars = axes @ axes.mT + 0.3 * torch.eye(2)
    conics = torch.linalg.inv(covars).flatten(-2)[..., [0, 1, 3]]
    opacities = torch.sigmoid(2 * torch.randn(shape, generator=random))
    reach = torch.sqrt(2 * torch.log(255 * opacities).clamp(min=0))
    radii = torch.ceil(reach[..., None] * covars.diagonal(dim1=-2, dim2=-1).sqrt()).int()
    depths = (1 + torch.rand(shape, generator=random)).mul(8).round().div(8)  # many ties
    return means2d, radii, depths, conics, opacities


def grid(tile_size: int) -> TileGrid:
    return TileGrid(tile_size, math.ceil(WIDTH / tile_size), math.ceil(HEIGHT / tile_size))


def assert_equal(seen: tuple[Tensor, ...], wanted: tuple[Tensor, ...]) -> None:
    for s, w in zip(seen, wanted, strict=True):
        assert s.dtype == w.dtype
        assert torch.equal(s, w)


def pairs(found: tuple[Tensor, Tensor, Tensor]) -> set[tuple[int, int]]:
    """(image and tile, splat) of every entry."""
    return set(zip((found[1] >> 32).tolist(), found[2].tolist(), strict=True))


@pytest.mark.parametrize("tile_size", [16, 8, 7, 40])
@pytest.mark.parametrize("image_dims", [(1,), (), (2, 3)])
@pytest.mark.parametrize("sort", [True, False])
def test_isect_tiles_of_boxes_equals_reference(tile_size: int, image_dims: tuple[int, ...], sort: bool) -> None:
    means2d, radii, depths, _, _ = splats(500, image_dims)
    args = (means2d, radii, depths, *grid(tile_size), sort)
    assert_equal(isect_tiles(*args), reference.isect_tiles(*args))


@pytest.mark.slow
@pytest.mark.parametrize("median_px", [0.5, 3.0, 40.0])
@pytest.mark.parametrize("tile_size", [16, 5])
def test_isect_tiles_exact_test_lists_touched_tiles_only(tile_size: int, median_px: float) -> None:
    means2d, radii, depths, conics, opacities = splats(800, median_px=median_px, seed=3)
    where = (radii, depths, *grid(tile_size))
    seen = pairs(isect_tiles(means2d, *where, conics=conics, opacities=opacities))
    exact = {"conics": conics.double(), "opacities": opacities.double()}
    assert pairs(reference.isect_tiles(means2d.double(), *where, **exact)) <= seen
    # Rounding may add a tile that the ellipse misses by a few thousandths of a pixel.
    exact["opacities"] = exact["opacities"] * 1.04
    assert seen <= pairs(reference.isect_tiles(means2d.double(), *where, **exact))
    assert len(seen) < 0.95 * len(isect_tiles(means2d, *where)[1])


def test_isect_tiles_exact_lists_render_same_image_as_boxes() -> None:
    means2d, radii, depths, conics, opacities = splats(2000, (2,), seed=5)
    radii = torch.where(radii > 0, radii + 1, 0)
    size, across, down = grid(16)
    colors = torch.rand(2, 2000, 3, generator=torch.Generator().manual_seed(1))
    images = []
    for exact in ({}, {"conics": conics, "opacities": opacities}):
        _, ids, order = isect_tiles(means2d, radii, depths, size, across, down, **exact)
        offsets = isect_offset_encode(ids, 2, across, down)
        images.append(rasterize_to_pixels(means2d, conics, colors, opacities, WIDTH, HEIGHT, size, offsets, order))
    assert_equal(images[0], images[1])


@pytest.mark.parametrize("exact", [True, False])
def test_bin_splats_equals_isect_tiles_with_offsets(exact: bool) -> None:
    means2d, radii, depths, conics, opacities = splats(700, (2, 2))
    options = {"conics": conics, "opacities": opacities} if exact else {}
    size, across, down = grid(16)
    counts, ids, order = isect_tiles(means2d, radii, depths, size, across, down, **options)
    offsets = isect_offset_encode(ids, 4, across, down)
    assert torch.equal(offsets, reference.isect_offset_encode(ids, 4, across, down))
    wanted = (counts, order, offsets.reshape(2, 2, down, across))
    assert_equal(bin_splats(means2d, radii, depths, grid(16), **options), wanted)
    assert (ids.diff() >= 0).all()


def test_isect_tiles_packed_equals_dense_lists() -> None:
    means2d, radii, depths, conics, opacities = splats(300, (3,))
    visible = (radii > 0).all(-1)
    image_ids, gaussian_ids = torch.where(visible)
    packed = dict(packed=True, n_images=3, image_ids=image_ids, gaussian_ids=gaussian_ids)
    chosen = [t[visible] for t in (means2d, radii, depths)]
    options = {"conics": conics[visible], "opacities": opacities[visible]}
    seen = isect_tiles(*chosen, *grid(16), **packed, **options)
    counts, ids, order = isect_tiles(means2d, radii, depths, *grid(16), conics=conics, opacities=opacities)
    row = torch.cumsum(visible.flatten(), 0) - 1
    assert_equal(seen, (counts[visible], ids, row[order.long()].int()))


@pytest.mark.parametrize("count", [0, 1, 64])
def test_bin_splats_without_visible_splats_gives_empty_lists(count: int) -> None:
    means2d, radii, depths, conics, opacities = splats(count)
    for hidden in (radii * 0, radii * torch.tensor([1, 0], dtype=torch.int32)):
        counts, order, offsets = bin_splats(means2d, hidden, depths, grid(16), conics=conics, opacities=opacities)
        assert order.numel() == 0
        assert not counts.any()
        assert not offsets.any()


def test_bin_splats_omits_non_finite_and_far_splats() -> None:
    means2d, radii, depths, conics, opacities = splats(14)
    means2d[:] = 50.0
    radii[:] = 20
    opacities[:] = 0.9
    means2d[0, 0, 0] = math.nan
    means2d[0, 1, 1] = math.inf
    means2d[0, 2, 0] = -3e38
    means2d[0, 3] = torch.tensor([3e9, -3e9])
    depths[0, 4] = math.nan
    depths[0, 5] = math.inf
    conics[0, 6, 0] = math.nan
    conics[0, 7, 2] = math.inf
    opacities[0, 8] = math.nan
    opacities[0, 9] = math.inf
    opacities[0, 10] = 0.0
    opacities[0, 11] = -1.0
    opacities[0, 12] = 0.9 / 255
    counts, order, _ = bin_splats(means2d, radii, depths, grid(16), conics=conics, opacities=opacities)
    assert counts[0, :13].tolist() == [0] * 13
    assert set(order.tolist()) == {13}
    assert isect_tiles(means2d, radii, depths, *grid(16))[0][0, :6].tolist() == [0] * 6


def test_bin_splats_lists_huge_splat_in_every_tile() -> None:
    _, across, down = grid(8)
    means2d = torch.tensor([[[1e4, -1e4]]])
    radii = torch.tensor([[[2**31 - 1, 2**31 - 1]]], dtype=torch.int32)
    conics = torch.tensor([[[1e-12, 0.0, 1e-12]]])
    counts, order, offsets = bin_splats(
        means2d, radii, torch.ones(1, 1), grid(8), conics=conics, opacities=torch.ones(1, 1)
    )
    assert counts.item() == order.numel() == across * down
    assert torch.equal(offsets.flatten(), torch.arange(across * down, dtype=torch.int32))


def test_isect_tiles_lists_thin_ellipse_along_axis_only() -> None:
    # 45 degrees, 400 px by 0.6 px: about two of the tiles of each row.
    direction = torch.tensor([[1.0, 1.0], [-1.0, 1.0]]) / math.sqrt(2)
    covar = direction.T @ torch.diag(torch.tensor([400.0**2, 0.6**2])) @ direction
    conics = torch.linalg.inv(covar.double()).float().flatten()[[0, 1, 3]].reshape(1, 1, 3)
    means2d, radii = torch.full((1, 1, 2), 50.0), torch.full((1, 1, 2), 1000, dtype=torch.int32)
    counts = isect_tiles(means2d, radii, torch.ones(1, 1), *grid(8), conics=conics, opacities=torch.ones(1, 1))[0]
    assert 13 <= counts.item() <= 3 * 13


def test_isect_tiles_independent_of_thread_count() -> None:
    means2d, radii, depths, conics, opacities = splats(30_000, median_px=1.0)
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(isect_tiles(means2d, radii, depths, *grid(16), conics=conics, opacities=opacities))
    finally:
        torch.set_num_threads(threads)
    assert_equal(found[0], found[1])
    assert_equal(found[0], found[2])
    ids, order = found[0][1:]
    assert torch.equal(
        torch.stack([ids, order.long()]), torch.stack([ids, order.long()])[:, torch.argsort(ids, stable=True)]
    )


@pytest.mark.parametrize("image_dims", [(1,), (), (2, 3)])
@pytest.mark.parametrize("share", [1.3, 1.0, 0.6, 0.001, 0.0])
def test_bin_splats_with_capacity_equals_reference(image_dims: tuple[int, ...], share: float) -> None:
    """Unused entries come first; on overflow the farthest splats are dropped completely."""
    here = splats(400, image_dims, median_px=8.0)[:3]
    exact = bin_splats(*here, grid(16))
    total = exact[1].numel()
    capacity = int(share * total)
    counts, order, offsets, needed = bin_splats(*here, grid(16), capacity=capacity)
    wanted = list(bin_splats_within(*here, grid(16), capacity=capacity))
    wanted[2] = wanted[2].reshape(offsets.shape)
    assert_equal((counts, order, offsets, needed), tuple(wanted))
    assert needed.tolist() == [total]
    if share >= 1:
        unused = capacity - total
        assert_equal((counts, order[unused:], offsets - unused), exact)


def test_bin_splats_with_capacity_gives_same_image_and_gradients() -> None:
    means2d, radii, depths, conics, opacities = splats(200, (2,))
    colors = torch.rand(2, 200, 3, generator=torch.Generator().manual_seed(1))
    results = []
    for capacity in (None, 20_000):
        lists = bin_splats(means2d, radii, depths, grid(16), conics=conics, opacities=opacities, capacity=capacity)
        leaves = [t.clone().requires_grad_() for t in (means2d, conics, colors, opacities)]
        image, _ = rasterize_to_pixels(*leaves, WIDTH, HEIGHT, 16, lists[2], lists[1])
        results.append((image, *torch.autograd.grad(image.square().sum(), leaves)))
    assert results[0][0].max() > 0.5
    assert_equal(*results)


def test_tile_ops_name_invalid_arguments() -> None:
    means2d, radii, depths, conics, _ = splats(5)
    with pytest.raises(InvalidInput, match=r"float64; gsplat_core\.reference"):
        isect_tiles(means2d.double(), radii, depths, *grid(16))
    with pytest.raises(InvalidInput, match="radii must be int32"):
        isect_tiles(means2d, radii.float(), depths, *grid(16))
    with pytest.raises(InvalidInput, match=r"means2d must have shape \(1, 5, 2\)"):
        isect_tiles(means2d[:, :4], radii, depths, *grid(16))
    with pytest.raises(InvalidInput, match="both conics and opacities"):
        isect_tiles(means2d, radii, depths, *grid(16), conics=conics)
    with pytest.raises(InvalidInput, match="packed splats need"):
        isect_tiles(means2d[0], radii[0], depths[0], *grid(16), packed=True)
    with pytest.raises(RuntimeError, match="image_ids"):
        isect_tiles(means2d[0], radii[0], depths[0], *grid(16), packed=True, n_images=1, image_ids=torch.full((5,), 7))
    for capacity in (-1, 2**31):
        with pytest.raises(InvalidInput, match=f"got {capacity}"):
            bin_splats(means2d, radii, depths, grid(16), capacity=capacity)
    with pytest.raises(RuntimeError, match="for image 5"):
        isect_offset_encode(torch.tensor([5 << 40]), 1, 10, 20)


@pytest.mark.slow
def test_tile_ops_pass_opcheck() -> None:
    means2d, radii, depths, conics, opacities = (t[0] for t in splats(40))
    ops = torch.ops.gsplat_core
    for exact in ((conics, opacities), (None, None)):
        args = (means2d, radii, depths, *exact, None, 1, *grid(16))
        torch.library.opcheck(ops.isect_tiles.default, (*args, True))
        torch.library.opcheck(ops.bin_splats.default, args)
        torch.library.opcheck(ops.bin_splats_within.default, (*args, 30))
    ids = isect_tiles(means2d, radii, depths, *grid(16))[1]
    torch.library.opcheck(ops.isect_offset_encode.default, (ids, 1, *grid(16)[1:]))
