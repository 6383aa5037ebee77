"""Lists of tiles, pixels of tiles, and limits of alpha."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core.experimental import cut_gaussians
from gsplat_core.experimental.cut_gaussians import GaussianKernel, render_kernel
from gsplat_core.ops.tiles import TileGrid
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians


def test_padded_pads_tile_lists_to_longest():
    lists, listed = cut_gaussians._padded(torch.tensor([0, 2, 2, 5]), torch.tensor([7, 8, 3, 4, 5, 9]))
    assert listed.tolist() == [[True, True, False], [False] * 3, [True] * 3, [True, False, False]]
    assert [row[keep].tolist() for row, keep in zip(lists, listed, strict=True)] == [[7, 8], [], [3, 4, 5], [9]]
    lists, listed = cut_gaussians._padded(torch.tensor([0, 0]), torch.zeros(0, dtype=torch.int64))
    assert lists.shape == listed.shape == (2, 1) and not listed.any()


def test_tile_pixels_are_centres_in_row_order():
    pixels = cut_gaussians._tile_pixels(TileGrid(16, 3, 2), torch.device("cpu"))
    assert pixels.shape == (6, 256, 2)
    assert pixels[0, 0].tolist() == [0.5, 0.5] and pixels[0, 17].tolist() == [1.5, 1.5]
    assert pixels[4, 0].tolist() == [16.5, 16.5] and pixels[5, 255].tolist() == [47.5, 31.5]


def splats(opacities, depths=(40.0,), colour=1.0, size=2.0):
    """Splats at the principal point of a camera, in front of each other."""
    count = len(opacities)
    means = torch.tensor([[0.0, 0.0, depth] for depth in depths])
    return Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 3), size).log(),
        torch.tensor(opacities).logit(), torch.full((count, 1, 3), (colour - 0.5) / SH_C0),
    )  # fmt: skip


CAMERA = Camera.from_focal(60.0, 33, 25)


def test_render_kernel_limits_opacity_and_blends_front_to_back():
    scene = splats([0.9999, 0.5], (40.0, 50.0))
    scene = replace(scene, sh=torch.stack([torch.full((1, 3), (each - 0.5) / SH_C0) for each in (1.0, 0.5)]))
    picture = render_kernel(scene, CAMERA, GaussianKernel(), torch.tensor([0.25, 0.0, 0.0]))
    middle = picture[12, 16]
    first, second = 0.99, 0.5
    expected = first * 1.0 + (1 - first) * second * 0.5
    assert picture.shape == (25, 33, 3)
    assert float(middle[1]) == pytest.approx(expected, abs=2e-3)
    assert float(middle[0]) == pytest.approx(expected + (1 - first) * (1 - second) * 0.25, abs=2e-3)
    torch.testing.assert_close(picture[0, 0], torch.tensor([0.25, 0.0, 0.0]))


@pytest.mark.parametrize(("opacity", "is_shown"), [(0.9 / 255, False), (1.1 / 255, True)])
def test_render_kernel_hides_alpha_below_level(opacity, is_shown):
    assert bool(render_kernel(splats([opacity]), CAMERA, GaussianKernel()).any()) == is_shown


def test_render_kernel_clamps_negative_colours_to_black():
    assert not render_kernel(splats([0.9], colour=-0.5), CAMERA, GaussianKernel()).any()
