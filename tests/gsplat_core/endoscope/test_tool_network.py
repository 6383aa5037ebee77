"""`NetworkToolFinder` finds drawn instruments in pictures of any size, and nothing on plain tissue."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.endoscope.tools import (
    NETWORK,
    ROUND_INPUT_PX,
    ROUND_INPUTS,
    ROUND_NETWORK,
    NetworkToolFinder,
    around_view,
    between_bars,
    remove_inner_regions,
    round_view,
)
from gsplat_core.errors import InvalidInput

from .tool_pictures import in_round_view, tissue, with_rod


@pytest.fixture(scope="module")
def finder():
    return NetworkToolFinder()


@pytest.mark.parametrize("size", [(256, 320), (540, 540), (360, 640)])
def test_network_finder_finds_instrument_at_any_image_size(finder, size):
    image, rod = with_rod(*size)
    found = finder.find(image)
    assert found.shape == size and found.dtype == np.uint8 and set(np.unique(found)) <= {0, 1}
    overlap = ((found == 0) & (rod == 1)).sum() / ((found == 0) | (rod == 1)).sum()
    assert overlap > 0.7


def test_network_finder_finds_nothing_on_plain_tissue(finder):
    assert finder.find(tissue(256, 320)).all()


def test_network_finder_masks_are_deterministic(finder):
    image, _ = with_rod(256, 320)
    first = finder.find(image)
    finder.find(tissue(256, 320))
    np.testing.assert_array_equal(finder.find(image), first)
    np.testing.assert_array_equal(NetworkToolFinder().find(image), first)


def test_network_finder_treats_tiny_image_as_tissue(finder):
    assert finder.find(np.full((20, 300, 3), 128, np.uint8)).all()


@pytest.mark.parametrize(
    "image", [np.zeros((64, 64), np.uint8), np.zeros((64, 64, 3), np.float32), np.zeros((64, 64, 4), np.uint8)]
)
def test_network_finder_rejects_arrays_other_than_rgb_uint8(finder, image):
    with pytest.raises(InvalidInput, match=r"image must be RGB uint8 \[H, W, 3\], got"):
        finder.find(image)


def test_remove_inner_regions_drops_small_regions_away_from_border():
    """A region at the border of the picture or of a round view stays, and so does a large one inside."""
    view = np.ones((96, 128), np.uint8)
    view[:, :20] = 0
    levels = np.full((96, 128), 100, np.uint8) * view
    at_the_border = (slice(0, 6), slice(60, 66)), (slice(40, 46), slice(21, 27))
    inside, large = (slice(40, 50), slice(50, 60)), (slice(60, 80), slice(70, 90))
    for place in (*at_the_border, inside, large):
        levels[place] = 200
    wanted = levels.copy()
    wanted[inside] = 0
    remove_inner_regions(levels, view)
    np.testing.assert_array_equal(levels, wanted)


def test_round_view_requires_four_dark_corners():
    image, _ = in_round_view(tissue(96, 128))
    assert round_view(image)
    assert not round_view(tissue(96, 128))
    printed = image.copy()
    printed[0, :6] = 200
    assert round_view(printed)
    printed[:6, :8] = 200
    assert not round_view(printed)


def test_network_finder_uses_separate_network_for_round_view(finder):
    """The network for round views finds the instrument inside the view and differs from the other network."""
    image, rod = with_rod(256, 320)
    image, inside = in_round_view(image)
    found = finder.find(image) == 0
    rod = (rod == 1) & inside
    assert (found & rod).sum() / (found | rod).sum() > 0.6
    assert not found[~inside].any()
    assert (found != (NetworkToolFinder(NETWORK).find(image) == 0)).any()


def test_network_finder_finds_nothing_on_plain_tissue_in_round_view(finder):
    assert finder.find(in_round_view(tissue(256, 320))[0]).all()


def test_network_finder_selects_network_by_view_shape(finder):
    full, _ = with_rod(256, 320)
    around = in_round_view(full)[0]
    only_full = NetworkToolFinder(NETWORK)
    only_round = NetworkToolFinder(ROUND_NETWORK, ROUND_INPUT_PX, ROUND_INPUTS)
    np.testing.assert_array_equal(finder.find(full), only_full.find(full))
    np.testing.assert_array_equal(finder.find(around), only_round.find(around))
    assert (only_full.find(around) != only_round.find(around)).any()


BARS = {
    "above and below": (40, 40, 0, 0),
    "beside": (0, 0, 60, 60),
    "around": (30, 31, 40, 41),
    "portrait": (0, 0, 400, 400),
}
"""Heights of black bars above and below a picture and widths of those beside it, in pixels."""


def barred(image, bars):
    above, below, left, right = bars
    return cv2.copyMakeBorder(image, above, below, left, right, cv2.BORDER_CONSTANT)


@pytest.mark.parametrize("bars", BARS.values(), ids=BARS)
def test_network_finder_result_independent_of_black_bars(finder, bars):
    image, _ = with_rod(256, 320)
    found = finder.find(barred(image, bars))
    np.testing.assert_array_equal(found, 1 - barred(1 - finder.find(image), bars))
    assert not found.all()


@pytest.mark.parametrize("bars", [(20, 20, 0, 0), (0, 0, 60, 60), (30, 31, 40, 41)], ids=str)
def test_network_finder_uses_round_network_with_black_bars(finder, bars):
    image = barred(in_round_view(with_rod(256, 320)[0])[0], bars)
    np.testing.assert_array_equal(finder.find(image), only_round().find(image))


def only_round():
    return NetworkToolFinder(ROUND_NETWORK, ROUND_INPUT_PX, ROUND_INPUTS)


@pytest.mark.parametrize("bars", [(300, 300, 0, 0), (150, 451, 0, 0), (0, 0, 400, 400), (0, 0, 100, 601)], ids=str)
def test_network_finder_round_view_result_independent_of_long_black_bars(finder, bars):
    """The view has the aspect ratio of the network's input."""
    view, _ = in_round_view(with_rod(240, 320)[0])
    found = finder.find(barred(view, bars))
    np.testing.assert_array_equal(found, 1 - barred(1 - finder.find(view), bars))
    assert not found.all()
    squashed = only_round().find(barred(view, bars))
    assert (squashed != found).any(), "a view that is resized with its bars is seen differently"


def test_around_view_crops_only_outside_supported_aspect_ratios():
    def examined(height, width, view=96):
        image = np.zeros((height, width, 3), np.uint8)
        top, left = (height - view) // 2, (width - view) // 2
        image[top : top + view, left : left + view] = 100
        return around_view(image, (128, 96))

    assert examined(120, 120) == (slice(0, 120), slice(0, 120))
    assert examined(120, 240) == (slice(0, 120), slice(0, 240))
    # A longer picture keeps the bars up to the aspect ratio of the input, 4:3, and the view in any case.
    assert examined(120, 242) == (slice(0, 120), slice(41, 201))
    assert examined(121, 120) == (slice(12, 108), slice(0, 120))
    assert examined(300, 120) == (slice(102, 198), slice(0, 120))
    assert examined(300, 120, view=60) == (slice(105, 195), slice(0, 120))


def test_around_view_stays_within_image():
    image = np.zeros((300, 120, 3), np.uint8)
    for top, rows in ((0, slice(0, 90)), (260, slice(210, 300))):
        shown = image.copy()
        shown[top : top + 40, 40:80] = 100
        assert around_view(shown, (128, 96)) == (rows, slice(0, 120))
    assert around_view(image, (128, 96)) == (slice(0, 300), slice(0, 120))


def test_between_bars_ignores_text_in_black_bar():
    image = barred(tissue(120, 160), (30, 20, 40, 10))
    image[5:12, 60:90] = 255
    assert between_bars(image) == (slice(30, 150), slice(40, 200))


def test_between_bars_of_black_image_is_whole_image():
    assert between_bars(np.zeros((96, 128, 3), np.uint8)) == (slice(None), slice(None))


def test_network_finder_treats_black_image_as_tissue(finder):
    assert finder.find(np.zeros((96, 128, 3), np.uint8)).all()


def test_network_finder_treats_narrow_strip_between_bars_as_tissue(finder):
    assert finder.find(barred(with_rod(20, 320)[0], (100, 100, 0, 0))).all()
