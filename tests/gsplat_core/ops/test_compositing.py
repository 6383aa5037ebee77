"""The compiled compositing, forward and backward, against plain torch in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.compositing import rasterize_to_pixels
from gsplat_core.reference import compositing as reference
from tests.gsplat_core.ops.compositing_scenes import Scene, assert_close, scene


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 7, 8, 9, 32])
def test_compositing_with_any_number_of_channels(channels: int) -> None:
    assert_close(scene(300, channels=channels, backgrounds=torch.rand(1, channels)), absgrad=True)


@pytest.mark.parametrize("tile_size", [4, 5, 8, 16, 20, 33, 64])
@pytest.mark.parametrize("size", [(1, 1), (33, 50)])
def test_compositing_with_any_tile_and_image_size(tile_size: int, size: tuple[int, int]) -> None:
    assert_close(scene(120, *size, tile_size=tile_size, backgrounds=torch.rand(1, 3)), absgrad=True)


@pytest.mark.parametrize("image_dims", [(), (3,), (2, 2), (0,)])
def test_compositing_with_leading_dimensions(image_dims: tuple[int, ...]) -> None:
    s = scene(60, 40, 20, image_dims=image_dims, backgrounds=torch.rand(*image_dims, 3))
    seen = s.run(rasterize_to_pixels, torch.float32)
    assert seen["image"].shape == (*image_dims, 20, 40, 3)
    assert seen["alphas"].shape == (*image_dims, 20, 40, 1)
    if 0 not in image_dims:
        assert_close(s)


def test_compositing_gradient_of_large_depth_channel() -> None:
    s = scene(500, channels=4)
    s.colors[..., 3] = 60 + 0.1 * s.colors[..., 3]
    assert_close(s, absgrad=True)


def test_compositing_of_opaque_splats_stops_pixel_without_gradient_at_ceiling() -> None:
    s = scene(400, median_px=6.0)
    s.opacities[:, ::2] = 1.0
    assert_close(s, absgrad=True)
    one = Scene(
        torch.full((1, 1, 2), 0.5), torch.tensor([[[1e-3, 0, 1e-3]]]), torch.ones(1, 1, 1), torch.ones(1, 1), 1, 1
    )
    seen = assert_close_or_zero(one)
    assert seen["alphas"].item() == pytest.approx(0.99, abs=1e-6)


def assert_close_or_zero(s: Scene) -> dict[str, Tensor]:
    seen = s.run(rasterize_to_pixels, torch.float32)
    for name in ("v_means2d", "v_conics", "v_opacities"):
        assert not seen[name].any()
    return seen


def test_compositing_stops_before_splat_exceeding_transmittance_limit() -> None:
    # Three splats of 0.95 leave 1.25e-4; a fourth would leave 6e-6 and is not blended, and nothing after it is.
    alphas = [0.95, 0.95, 0.95, 0.95, 0.01]
    s = Scene(
        torch.full((1, 5, 2), 0.5),
        torch.tensor([1e-9, 0.0, 1e-9]).expand(1, 5, 3).contiguous(),
        torch.eye(5)[None],
        torch.tensor([alphas]),
        1,
        1,
    )
    seen = s.run(rasterize_to_pixels, torch.float32)
    wanted = torch.tensor([0.95, 0.95 * 0.05, 0.95 * 0.05**2, 0.0, 0.0])
    torch.testing.assert_close(seen["image"].flatten(), wanted, rtol=1e-5, atol=1e-7)
    assert not seen["v_colors"][0, 3:].any()


def test_compositing_skips_faint_splats_and_negative_sigma() -> None:
    # Below 1/255 at the centre; indefinite conics, whose sigma is negative along an axis.
    s = scene(60, median_px=5.0)
    s.opacities[:, ::3] = 0.9 / 255
    s.conics[:, 1::3] = torch.tensor([0.05, 0.0, -0.04])
    s.conics[:, 4::9] = torch.tensor([0.02, 0.05, 0.02])
    assert_close(s)


def test_compositing_of_thin_huge_and_tiny_splats() -> None:
    s = scene(200, 90, 60, median_px=4.0)
    direction = torch.tensor([[1.0, 1.0], [-1.0, 1.0]]) / math.sqrt(2)
    thin = direction.T @ torch.diag(torch.tensor([1 / 80.0**2, 1 / 0.6**2])) @ direction
    s.conics[:, ::5] = thin.flatten()[[0, 1, 3]]
    s.conics[:, 1::5] = torch.tensor([1e-8, 0.0, 1e-8])
    s.conics[:, 2::5] = torch.tensor([3.3, 0.0, 3.3])
    s.conics[:, 3::25] = 0.0
    assert_close(s, absgrad=True)


def test_compositing_skips_non_finite_splats_without_gradient() -> None:
    s = scene(200, channels=3)
    bad = torch.zeros(200, dtype=torch.bool)
    for row, value in enumerate((math.nan, math.inf, -math.inf)):
        for column, (tensor, channel) in enumerate(
            ((s.means2d, 0), (s.means2d, 1), (s.conics, 0), (s.conics, 1), (s.conics, 2), (s.colors, 0), (s.colors, 2))
        ):
            tensor[0, 8 * row + column, channel] = value
        s.opacities[0, 8 * row + 7] = value
    bad[:24] = True
    seen = s.run(rasterize_to_pixels, torch.float32, absgrad=True)
    good = replace(s, **{n: getattr(s, n)[:, ~bad] for n in ("means2d", "conics", "colors", "opacities")})
    wanted = good.run(rasterize_to_pixels, torch.float32, absgrad=True)
    assert torch.equal(seen["image"], wanted["image"])
    for name in ("v_means2d", "v_conics", "v_colors", "v_opacities", "absgrad"):
        assert not seen[name][:, bad].any()
        assert torch.equal(seen[name][:, ~bad], wanted[name])
    assert_close(s)


def test_compositing_masked_tiles_show_background_only() -> None:
    masks = torch.rand(2, 3, 5, generator=torch.Generator().manual_seed(2)) > 0.4
    s = scene(150, image_dims=(2,), masks=masks, backgrounds=torch.rand(2, 3))
    seen = assert_close(s)
    hidden = ~masks.repeat_interleave(16, 1).repeat_interleave(16, 2)[:, :45, :70]
    assert not seen["alphas"][..., 0][hidden].any()


@pytest.mark.parametrize("count", [0, 1])
def test_compositing_of_empty_and_nearly_empty_scenes(count: int) -> None:
    background = torch.tensor([[0.1, 0.2, 0.3]])
    seen = scene(count, 33, 17, median_px=0.01, backgrounds=background).run(rasterize_to_pixels, torch.float32)
    if count == 0:
        assert torch.equal(seen["image"], background.expand(1, 17, 33, 3))
        assert not seen["alphas"].any()
    else:
        assert 0 < (seen["alphas"] > 0).sum() <= 16


@pytest.mark.slow
def test_compositing_of_very_many_splats_in_one_tile() -> None:
    s = scene(20_000, 16, 16, median_px=8.0)
    s.opacities[:] = 0.004  # just visible, so that many are blended before the pixel ends
    # A splat is blended where its alpha is at least 1/255. Rounding decides for a splat within a few float32 steps
    # of that bound at some pixel, and the gradient of that splat then differs by the whole share of the pixel.
    columns, rows = torch.meshgrid(torch.arange(16.0) + 0.5, torch.arange(16.0) + 0.5, indexing="xy")
    dx = columns.flatten().double() - s.means2d[..., :1].double()
    dy = rows.flatten().double() - s.means2d[..., 1:].double()
    a, b, c = s.conics.double().unbind(-1)
    sigma = 0.5 * (a[..., None] * dx**2 + c[..., None] * dy**2) + b[..., None] * dx * dy
    undecided = ((0.004 * 255 * torch.exp(-sigma) - 1).abs() < 1e-5).any(-1)
    assert undecided.sum() < 0.2 * undecided.numel()
    s.opacities[undecided] = 0.9 / 255
    assert_close(s)


def test_compositing_packed_equals_dense() -> None:
    s = scene(80, image_dims=(2,))
    offsets, flatten_ids = s.lists()
    dense = rasterize_to_pixels(s.means2d, s.conics, s.colors, s.opacities, s.width, s.height, 16, offsets, flatten_ids)
    flat = [t.flatten(0, 1) for t in (s.means2d, s.conics, s.colors, s.opacities)]
    packed = rasterize_to_pixels(*flat, s.width, s.height, 16, offsets, flatten_ids, packed=True)
    assert all(torch.equal(d, p) for d, p in zip(dense, packed, strict=True))


def test_compositing_deterministic_and_independent_of_thread_count() -> None:
    s = scene(3000, 300, 200, channels=4, backgrounds=torch.rand(1, 4))
    threads = torch.get_num_threads()
    try:
        runs = []
        for count in (1, 2, 2, 3):
            torch.set_num_threads(count)
            runs.append(s.run(rasterize_to_pixels, torch.float32, absgrad=True))
    finally:
        torch.set_num_threads(threads)
    for other in runs[1:]:
        assert all(torch.equal(other[name], value) for name, value in runs[0].items())


@pytest.mark.slow
def test_compositing_reference_passes_gradcheck() -> None:
    s = scene(6, 5, 4, channels=2, median_px=2.0, seed=4)
    inputs = [t.double().requires_grad_() for t in (s.means2d, s.conics, s.colors, s.opacities, torch.rand(1, 2))]
    lists = s.lists()
    assert torch.autograd.gradcheck(
        lambda m, q, c, o, b: reference.rasterize_to_pixels(m, q, c, o, 5, 4, 16, *lists, backgrounds=b),
        inputs,
        atol=1e-4,
    )


def test_compositing_names_invalid_arguments() -> None:
    s = scene(5)
    offsets, flatten_ids = s.lists()
    rest = (s.width, s.height, 16, offsets, flatten_ids)
    with pytest.raises(InvalidInput, match=r"float64; gsplat_core\.reference"):
        rasterize_to_pixels(s.means2d.double(), s.conics, s.colors, s.opacities, *rest)
    with pytest.raises(InvalidInput, match=r"conics must have shape \(1, 5, 3\)"):
        rasterize_to_pixels(s.means2d, s.means2d, s.colors, s.opacities, *rest)
    with pytest.raises(InvalidInput, match="backgrounds must have shape"):
        rasterize_to_pixels(s.means2d, s.conics, s.colors, s.opacities, *rest, backgrounds=torch.zeros(3))
    with pytest.raises(InvalidInput, match="do not cover the image"):
        rasterize_to_pixels(s.means2d, s.conics, s.colors, s.opacities, 500, 45, 16, offsets, flatten_ids)
    for most in (0.0, 1.0, math.nan):
        with pytest.raises(InvalidInput, match="max_alpha must be from 1/255"):
            rasterize_to_pixels(s.means2d, s.conics, s.colors, s.opacities, *rest, max_alpha=most)
    with pytest.raises(RuntimeError, match="flatten_ids must be in"):
        rasterize_to_pixels(s.means2d, s.conics, s.colors, s.opacities, *rest[:4], flatten_ids + 5)
    with pytest.raises(RuntimeError, match="isect_offsets must rise"):
        rasterize_to_pixels(s.means2d, s.conics, s.colors, s.opacities, *rest[:3], offsets.flip(-1), flatten_ids)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("limit", [(), (0.999,)])
def test_compositing_ops_pass_opcheck(background: bool, limit: tuple[float, ...]) -> None:
    s = scene(30, 20, 18)
    offsets, flatten_ids = s.lists()
    splats = [t[0].requires_grad_() for t in (s.means2d, s.conics, s.colors, s.opacities)]
    behind = torch.rand(1, 3, requires_grad=True) if background else None
    masks = torch.ones(1, 2, 2, dtype=torch.bool) if background else None
    probe = torch.zeros(30, 2, requires_grad=True) if background else None
    ops = torch.ops.gsplat_core
    torch.library.opcheck(
        ops.composite.default, (*splats, offsets, flatten_ids, behind, masks, probe, s.width, s.height, 16, *limit)
    )
    with torch.no_grad():
        plain = [t.detach() for t in splats]
        image, alphas, last = ops.composite(
            *plain, offsets, flatten_ids, behind, masks, None, s.width, s.height, 16, *limit
        )
        torch.library.opcheck(
            ops.composite_backward.default,
            (
                *plain,
                offsets,
                flatten_ids,
                behind,
                masks,
                s.width,
                s.height,
                16,
                alphas,
                last,
                image,
                alphas,
                background,
                *limit,
            ),
        )
