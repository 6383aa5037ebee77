"""The tile lists of the CUDA kernels, against plain torch and against the CPU's."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.tiles import bin_splats, isect_offset_encode, isect_tiles
from gsplat_core.reference import projection as reference
from gsplat_core.reference.rendering import bin_splats_within

WIDTH, HEIGHT = 150, 100


def splats(count: int, image_dims: tuple[int, ...] = (1,), seed: int = 0, median_px: float = 3.0) -> list[Tensor]:
    """means2d, radii, depths, conics, opacities of random ellipses in and around the image, on the CPU."""
    random = torch.Generator().manual_seed(seed)
    shape = (*image_dims, count)
    means2d = torch.rand(*shape, 2, generator=random) * torch.tensor([WIDTH + 60.0, HEIGHT + 60.0]) - 30
    size = median_px * torch.exp(0.7 * torch.randn(*shape, 1, 1, generator=random))
    axes = torch.randn(*shape, 2, 2, generator=random) * size
    covars = axes @ axes.mT + 0.3 * torch.eye(2)
    conics = torch.linalg.inv(covars).flatten(-2)[..., [0, 1, 3]]
    opacities = torch.sigmoid(2 * torch.randn(shape, generator=random))
    reach = torch.sqrt(2 * torch.log(255 * opacities).clamp(min=0))
    radii = torch.ceil(reach[..., None] * covars.diagonal(dim1=-2, dim2=-1).sqrt()).int()
    depths = (1 + torch.rand(shape, generator=random)).mul(8).round().div(8)  # many ties
    depths[..., ::7] *= -1
    return [means2d, radii, depths, conics, opacities]


def grid(tile_size: int) -> TileGrid:
    return TileGrid(tile_size, math.ceil(WIDTH / tile_size), math.ceil(HEIGHT / tile_size))


def cuda(tensors: list[Tensor]) -> list[Tensor]:
    return [t.cuda() for t in tensors]


def assert_equal(seen: tuple[Tensor, ...], wanted: tuple[Tensor, ...]) -> None:
    for s, w in zip(seen, wanted, strict=True):
        assert s.dtype == w.dtype
        assert torch.equal(s.cpu(), w.cpu())


def pairs(found: tuple[Tensor, Tensor, Tensor]) -> set[tuple[int, int]]:
    """(image and tile, splat) of every entry."""
    return set(zip((found[1] >> 32).tolist(), found[2].tolist(), strict=True))


@pytest.mark.parametrize("tile_size", [16, 7])
@pytest.mark.parametrize("image_dims", [(1,), (), (2, 3)])
@pytest.mark.parametrize("sort", [True, False])
def test_isect_tiles_of_boxes_equals_cpu_and_reference(tile_size: int, image_dims: tuple[int, ...], sort: bool) -> None:
    here = splats(500, image_dims)[:3]
    seen = isect_tiles(*cuda(here), *grid(tile_size), sort)
    assert seen[0].is_cuda
    assert_equal(seen, isect_tiles(*here, *grid(tile_size), sort))
    assert_equal(seen, reference.isect_tiles(*here, *grid(tile_size), sort))


@pytest.mark.parametrize("median_px", [0.5, 3.0, 40.0])
@pytest.mark.parametrize("tile_size", [16, 5])
def test_isect_tiles_exact_test_lists_touched_tiles_only(tile_size: int, median_px: float) -> None:
    means2d, radii, depths, conics, opacities = splats(800, median_px=median_px, seed=3)
    *where, gpu_conics, gpu_opacities = cuda([means2d, radii, depths, conics, opacities])
    found = isect_tiles(*where, *grid(tile_size), conics=gpu_conics, opacities=gpu_opacities)
    seen = pairs(found)
    exact = {"conics": conics.double(), "opacities": opacities.double()}
    assert pairs(reference.isect_tiles(means2d.double(), radii, depths, *grid(tile_size), **exact)) <= seen
    # Rounding may add a tile that the ellipse misses by a few thousandths of a pixel.
    exact["opacities"] = exact["opacities"] * 1.04
    assert seen <= pairs(reference.isect_tiles(means2d.double(), radii, depths, *grid(tile_size), **exact))
    on_cpu = isect_tiles(means2d, radii, depths, *grid(tile_size), conics=conics, opacities=opacities)
    assert len(pairs(on_cpu) ^ seen) <= 1e-3 * len(seen) + 1
    # By image, tile and depth, ties by index.
    ids, order = found[1], found[2].long()
    again = torch.argsort(ids, stable=True)
    assert (ids.diff() >= 0).all()
    assert torch.equal(again, torch.arange(len(ids), device="cuda"))
    assert ((order.diff() > 0) | (ids.diff() > 0)).all()


@pytest.mark.parametrize("exact", [True, False])
def test_bin_splats_equals_isect_tiles_with_offsets(exact: bool) -> None:
    means2d, radii, depths, conics, opacities = cuda(splats(700, (2, 2)))
    options = {"conics": conics, "opacities": opacities} if exact else {}
    size, across, down = grid(16)
    counts, ids, order = isect_tiles(means2d, radii, depths, size, across, down, **options)
    offsets = isect_offset_encode(ids, 4, across, down)
    assert torch.equal(offsets.cpu(), reference.isect_offset_encode(ids.cpu(), 4, across, down))
    wanted = (counts, order, offsets.reshape(2, 2, down, across))
    assert_equal(bin_splats(means2d, radii, depths, grid(16), **options), wanted)


@pytest.mark.parametrize("image_dims", [(1,), (2, 3)])
@pytest.mark.parametrize("share", [1.3, 1.0, 0.6, 0.001, 0.0])
def test_bin_splats_with_capacity_equals_reference(image_dims: tuple[int, ...], share: float) -> None:
    here = splats(400, image_dims, median_px=8.0)[:3]
    capacity = int(share * int(isect_tiles(*here, *grid(16))[0].sum()))
    seen = bin_splats(*cuda(here), grid(16), capacity=capacity)
    assert all(t.is_cuda for t in seen)
    wanted = list(bin_splats_within(*here, grid(16), capacity=capacity))
    wanted[2] = wanted[2].reshape(seen[2].shape)
    assert_equal(seen, tuple(wanted))
    assert_equal(seen, bin_splats(*here, grid(16), capacity=capacity))


@pytest.mark.parametrize("count", [0, 5])
def test_bin_splats_with_capacity_without_splats(count: int) -> None:
    means2d, radii, depths, conics, opacities = cuda(splats(count))
    exact = {"conics": conics, "opacities": opacities}
    _, order, offsets, needed = bin_splats(means2d, radii * 0, depths, grid(16), **exact, capacity=9)
    assert order.tolist() == [-1] * 9
    assert (offsets == 9).all()
    assert needed.tolist() == [0]


def test_bin_splats_rejects_capacity_out_of_range() -> None:
    for capacity in (-1, 2**31):
        with pytest.raises(InvalidInput, match=f"got {capacity}"):
            bin_splats(*cuda(splats(5))[:3], grid(16), capacity=capacity)


def test_bin_splats_with_capacity_in_graph_reports_overflow() -> None:
    means2d, radii, depths, conics, opacities = cuda(splats(600))
    exact = {"conics": conics, "opacities": opacities}
    small = means2d.clone()
    small[:, 60:] = -1e4  # most are out of sight at first
    needed = int(bin_splats(means2d, radii, depths, grid(16), **exact, capacity=0)[3])
    where = small.clone()
    bin_splats(where, radii, depths, grid(16), **exact, capacity=needed)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):  # a host that waited would be refused here
        lists = bin_splats(where, radii, depths, grid(16), **exact, capacity=needed // 2)
    for means in (small, means2d, small):
        where.copy_(means)
        graph.replay()
        assert_equal(lists, bin_splats(means, radii, depths, grid(16), **exact, capacity=needed // 2))
        assert (int(lists[3]) > needed // 2) == (means is means2d)


def test_isect_tiles_of_mixed_footprints_equals_reference() -> None:
    """Cover sizes from one tile to the whole image, and none, next to each other: 256 rows of tiles, 40 columns."""
    random = torch.Generator().manual_seed(4)
    where = [torch.rand(1, 300, n, generator=random) for n in (2, 2)]
    means2d = where[0] * torch.tensor([160.0, 1024.0])
    radii = torch.exp(7 * where[1]).int()
    depths = torch.rand(1, 300, generator=random)
    seen = isect_tiles(*cuda([means2d, radii, depths]), 4, 40, 256)
    assert_equal(seen, reference.isect_tiles(means2d, radii, depths, 4, 40, 256))
    axes = radii.float().clamp(min=1)
    conics = torch.stack([9 / axes[..., 0] ** 2, 1 / axes.prod(-1), 9 / axes[..., 1] ** 2], -1)
    opacities = torch.ones(1, 300)
    exact = {"conics": conics, "opacities": opacities}
    on_cpu = pairs(isect_tiles(means2d, radii, depths, 4, 40, 256, **exact))
    gpu = {name: t.cuda() for name, t in exact.items()}
    on_gpu = pairs(isect_tiles(*cuda([means2d, radii, depths]), 4, 40, 256, **gpu))
    assert len(on_gpu ^ on_cpu) <= 1e-3 * len(on_cpu)


def test_isect_tiles_packed_equals_dense_lists() -> None:
    means2d, radii, depths, conics, opacities = cuda(splats(300, (3,)))
    visible = (radii > 0).all(-1)
    image_ids, gaussian_ids = torch.where(visible)
    packed = dict(packed=True, n_images=3, image_ids=image_ids, gaussian_ids=gaussian_ids)
    chosen = [t[visible] for t in (means2d, radii, depths)]
    seen = isect_tiles(*chosen, *grid(16), **packed, conics=conics[visible], opacities=opacities[visible])
    counts, ids, order = isect_tiles(means2d, radii, depths, *grid(16), conics=conics, opacities=opacities)
    row = torch.cumsum(visible.flatten(), 0) - 1
    assert_equal(seen, (counts[visible], ids, row[order.long()].int()))


@pytest.mark.parametrize("count", [0, 1, 64])
def test_bin_splats_without_visible_splats_gives_empty_lists(count: int) -> None:
    means2d, radii, depths, conics, opacities = cuda(splats(count))
    counts, order, offsets = bin_splats(means2d, radii * 0, depths, grid(16), conics=conics, opacities=opacities)
    assert order.numel() == 0
    assert counts.shape == (1, count)
    assert not counts.any()
    assert offsets.shape == (1, 7, 10)
    assert not offsets.any()


def test_bin_splats_omits_non_finite_and_far_splats() -> None:
    means2d, radii, depths, conics, opacities = splats(14)
    means2d[:], radii[:], opacities[:] = 50.0, 20, 0.9
    means2d[0, 0, 0], means2d[0, 1, 1], means2d[0, 2, 0] = math.nan, math.inf, -3e38
    means2d[0, 3] = torch.tensor([3e9, -3e9])
    depths[0, 4], depths[0, 5], conics[0, 6, 0], conics[0, 7, 2] = math.nan, math.inf, math.nan, math.inf
    opacities[0, 8:13] = torch.tensor([math.nan, math.inf, 0.0, -1.0, 0.9 / 255])
    means2d, radii, depths, conics, opacities = cuda([means2d, radii, depths, conics, opacities])
    counts, order, _ = bin_splats(means2d, radii, depths, grid(16), conics=conics, opacities=opacities)
    assert counts[0, :13].tolist() == [0] * 13
    assert set(order.tolist()) == {13}


def test_isect_tiles_omits_invalid_image_ids() -> None:
    means2d, radii, depths, _, _ = (t[0] for t in cuda(splats(50)))
    image_ids = torch.full((50,), 7, device="cuda")
    counts, _, order = isect_tiles(means2d, radii, depths, *grid(16), packed=True, n_images=2, image_ids=image_ids)
    assert not counts.any()
    assert not order.numel()


def test_bin_splats_lists_huge_splat_in_every_tile() -> None:
    _, across, down = grid(8)
    means2d = torch.tensor([[[1e4, -1e4]]], device="cuda")
    radii = torch.full((1, 1, 2), 2**31 - 1, dtype=torch.int32, device="cuda")
    conics = torch.tensor([[[1e-12, 0.0, 1e-12]]], device="cuda")
    one = torch.ones(1, 1, device="cuda")
    counts, order, offsets = bin_splats(means2d, radii, one, grid(8), conics=conics, opacities=one)
    assert counts.item() == order.numel() == across * down
    assert torch.equal(offsets.flatten(), torch.arange(across * down, dtype=torch.int32, device="cuda"))


def test_bin_splats_is_deterministic_and_runs_on_side_stream() -> None:
    means2d, radii, depths, conics, opacities = cuda(splats(100_000, median_px=1.0))
    found = [bin_splats(means2d, radii, depths, grid(16), conics=conics, opacities=opacities) for _ in range(2)]
    assert_equal(found[0], found[1])
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        aside = bin_splats(means2d, radii, depths, grid(16), conics=conics, opacities=opacities)
    stream.synchronize()
    assert_equal(found[0], aside)


def test_bin_splats_accepts_strided_inputs() -> None:
    means2d, radii, depths, conics, opacities = cuda(splats(400))
    wanted = bin_splats(means2d, radii, depths, grid(16), conics=conics, opacities=opacities)
    wide = torch.cat([conics, conics], -1)[..., :3]
    turned = means2d.mT.contiguous().mT
    assert_equal(bin_splats(turned, radii, depths, grid(16), conics=wide, opacities=opacities), wanted)


def test_tile_ops_pass_opcheck() -> None:
    means2d, radii, depths, conics, opacities = (t[0] for t in cuda(splats(40)))
    ops = torch.ops.gsplat_core
    args = (means2d, radii, depths, conics, opacities, None, 1, *grid(16))
    torch.library.opcheck(ops.isect_tiles.default, (*args, True))
    torch.library.opcheck(ops.bin_splats.default, args)
    torch.library.opcheck(ops.bin_splats_within.default, (*args, 30))
    ids = isect_tiles(means2d, radii, depths, *grid(16))[1]
    torch.library.opcheck(ops.isect_offset_encode.default, (ids, 1, *grid(16)[1:]))
