"""Redness, its histogram and threshold, field of view, and held tools of `ToolFinder`, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.endoscope import tools
from gsplat_core.endoscope.tools import (
    BIN_CENTRES,
    BIN_EDGES,
    EXPECTED_VALLEY,
    FINE_EDGES,
    HIGHEST_VALLEY,
    LONG_SIDE_PX,
    NO_VALLEY,
    SMALLEST_PX,
    ToolFinder,
    View,
    field_of_view,
    valley,
    view_of,
)


def peaks(grey: float, red: float, share: float = 0.3, width: float = 0.03) -> np.ndarray:
    """Return the distribution of a grey and a red peak with a share of grey pixels."""
    bell = lambda centre: np.exp(-0.5 * ((BIN_CENTRES - centre) / width) ** 2)
    return share * bell(grey) / bell(grey).sum() + (1 - share) * bell(red) / bell(red).sum()


@pytest.mark.parametrize(("grey", "red"), [(0.0, 0.3), (0.05, 0.4), (-0.05, 0.25)])
def test_valley_lies_between_tool_and_tissue_peaks(grey, red):
    threshold, found = valley(peaks(grey, red))
    assert found and grey + 0.06 < threshold < red - 0.06


def test_valley_without_two_peaks_returns_default():
    for histogram in (None, peaks(0.3, 0.3), np.full(100, 0.01)):
        assert valley(histogram) == (NO_VALLEY, False)


def test_valley_prefers_candidate_nearest_to_expected():
    """The distribution has three equal peaks at equal distances."""
    bell = lambda centre: np.exp(-0.5 * ((BIN_CENTRES - centre) / 0.02) ** 2)
    histogram = bell(-0.15) + bell(0.05) + bell(0.25)
    threshold, found = valley(histogram / histogram.sum())
    assert found and abs(threshold - EXPECTED_VALLEY) < 0.05


def test_valley_rejected_beyond_pale_tissue():
    assert valley(peaks(0.3, 0.65))[1] is False
    threshold, found = valley(peaks(0.15, 0.45))
    assert found and threshold <= HIGHEST_VALLEY


@pytest.mark.parametrize(("share", "found"), [(0.001, False), (0.05, True)])
def test_valley_ignores_few_grey_pixels(share, found):
    """Three of a thousand pixels must be greyer than the threshold."""
    assert valley(peaks(0.0, 0.4, share))[1] == found


@pytest.mark.parametrize("stretch", [1.0, 2.0, 4.0])
def test_histogram_with_stretch_equals_histogram_of_stretched_values(stretch):
    values = np.random.default_rng(0).normal(0.1 / stretch, 0.1 / stretch, 20_000)
    below = np.append(0.0, np.cumsum(np.histogram(values, FINE_EDGES)[0]))
    found = tools._histogram(below, stretch)
    expected = np.histogram(np.clip(stretch * values, BIN_EDGES[0], BIN_EDGES[-1]), BIN_EDGES)[0] / len(values)
    assert found.sum() == pytest.approx(1) and np.abs(found - expected).sum() < 0.03
    far = np.append(0.0, np.cumsum(np.histogram(np.array([-2.0, 2.0, 2.0, 2.0]), FINE_EDGES)[0]))
    assert tools._histogram(far, 1.0)[[0, -1]].tolist() == [0.25, 0.75], "values beyond count in the outer bins"


def test_redness_is_logarithm_of_red_over_green_and_blue():
    """Red is compared half with the mean and half with the minimum of green and blue, with an offset for dark pixels."""
    red, green, blue = 200, 80, 120
    view = view_of(np.full((60, 80, 3), (red, green, blue), np.uint8))
    floor = 0.06 * 200
    log = lambda value: np.log(value + floor)
    expected = log(red) - 0.25 * log(green) - 0.25 * log(blue) - 0.5 * log(80)
    np.testing.assert_allclose(view.redness, expected, rtol=1e-4)
    assert (view.brightness == 200).all() and view.levels[200] == view.inside.sum() == 60 * 80
    dark = view_of(np.full((60, 80, 3), (20, 10, 10), np.uint8))  # the offset is 3 levels at least
    np.testing.assert_allclose(dark.redness, np.log(23 / 13), rtol=1e-4)


@pytest.mark.parametrize(("size", "small"), [((80, 60), (80, 60)), ((320, 200), (160, 100)), ((200, 640), (50, 160))])
def test_view_of_reduces_image_by_longer_side(size, small):
    view = view_of(np.full((size[1], size[0], 3), 90, np.uint8))
    assert view.redness.shape == view.inside.shape == small[::-1] and max(small) <= LONG_SIDE_PX


def test_field_of_view_excludes_darkness_connected_to_border():
    bright = np.full((40, 60), 200, np.uint8)
    bright[:, :10] = 23
    bright[15:25, 30:40] = 5  # a cavity
    inside = field_of_view(bright)
    expected = np.ones((40, 60), np.uint8)
    expected[:, :11] = 0  # and the outermost pixels
    np.testing.assert_array_equal(inside, expected)
    bright[:, :10] = 24
    assert field_of_view(bright).all()


@pytest.mark.parametrize(("level", "is_dark"), [(8, True), (9, False)])
def test_field_of_view_dark_threshold(level, is_dark):
    bright = np.full((40, 60), 60, np.uint8)  # 0.15 times 60 levels are 9
    bright[:5] = level
    assert (field_of_view(bright)[0, 0] == 0) == is_dark


def redness(value: float, spread: float = 0.05) -> np.ndarray:
    return np.random.default_rng(0).normal(value, spread, (80, 100)).astype(np.float32)


LIT = np.ones((80, 100), np.uint8)


@pytest.mark.parametrize(("value", "stretch"), [(0.9, 1.0), (0.4, 2.0), (0.1, 4.0), (0.05, 4.0)])
def test_tool_finder_stretches_pale_scenes_up_to_four_times(value, stretch):
    finder, plane = ToolFinder(), redness(value, 1e-4)
    np.testing.assert_allclose(finder._stretched(plane, LIT), stretch * plane, rtol=0.02)
    assert finder._histogram.sum() == pytest.approx(1)


def test_tool_finder_histogram_adapts_by_tenth_and_restarts_in_new_scene():
    finder = ToolFinder()
    finder._stretched(redness(0.4, 0.3), LIT)
    first, stretch = finder._histogram.copy(), finder._stretch
    finder._previous = LIT
    shifted = redness(0.42, 0.3)
    finder._stretched(shifted, LIT)
    own = ToolFinder()
    own._stretched(shifted, LIT)
    assert finder._stretch == pytest.approx(stretch + 0.1 * (own._stretch - stretch))
    assert np.abs(finder._histogram - first).sum() < 0.15 * np.abs(own._histogram - first).sum() + 0.02
    assert finder._previous is LIT
    finder._stretched(redness(-0.5, 0.05), LIT)
    assert finder._previous is None, "the masks of another scene are no evidence"
    assert np.abs(finder._histogram - first).sum() > 1


def view(level: int = 100) -> View:
    levels = np.zeros(256)
    levels[level] = 8000
    return View(redness(0.4), np.full((80, 100), level, np.uint8), LIT, levels)


def held(monkeypatch: pytest.MonkeyPatch, shares: list[float]) -> list[float]:
    """Return the shares of the picture that are tools in frames in which such shares are found."""
    finder, found = ToolFinder(), []
    monkeypatch.setattr(finder, "_stretched", lambda plane, lit: plane)
    monkeypatch.setattr(tools, "tool_regions", lambda regions: None)
    for share in shares:
        mask = np.zeros((80, 100), np.uint8)
        mask[:, : round(100 * share)] = 1
        monkeypatch.setattr(tools, "whole_tools", lambda regions, _, mask=mask: mask)
        found.append(float(finder._find(view()).mean()))
    return found


def test_tool_finder_holds_tools_three_frames_after_large_loss(monkeypatch):
    assert held(monkeypatch, [0.5, 0.2, 0.07, 0.07]) == [0.5, 0.2, 0.2, 0.2]
    assert held(monkeypatch, [0.5, 0.1, 0.1, 0.1, 0.1, 0.1]) == [0.5, 0.5, 0.5, 0.5, 0.1, 0.1]
    assert held(monkeypatch, [0.5, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0]) == [0.5, 0.5, 0.4, 0.4, 0.4, 0.4, 0.0]
    assert held(monkeypatch, [0.1, 0.9, 0.3, 0.3]) == [0.1, 0.9, 0.9, 0.9]


def test_tool_finder_dark_image_has_no_tools_and_clears_previous(monkeypatch):
    finder = ToolFinder()
    finder._previous = LIT
    assert not finder._find(view(0)).any() and finder._previous is None


@pytest.mark.parametrize(("side", "is_examined"), [(SMALLEST_PX, True), (SMALLEST_PX - 1, False)])
def test_tool_finder_treats_small_images_as_tissue(monkeypatch, side, is_examined):
    finder = ToolFinder()
    monkeypatch.setattr(finder, "_find", lambda view: np.ones(view.redness.shape, np.uint8))
    for shape in ((side, 40), (40, side)):
        assert finder.find(np.full((*shape, 3), 90, np.uint8)).any() != is_examined
