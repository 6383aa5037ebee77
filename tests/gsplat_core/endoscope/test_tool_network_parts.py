"""Input and output of the tool networks, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.endoscope import tools
from gsplat_core.endoscope.tools import (
    CERTAIN,
    NETWORK_INNER_REGION,
    along_edges,
    features,
    remove_inner_regions,
    round_view,
)


def test_features_are_colours_and_logarithms_of_ratios():
    small = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    planes = features(small, 8)[0]
    np.testing.assert_allclose(planes[:3], small.transpose(2, 0, 1) / 255 * 2 - 1, atol=1e-6)
    red, green, blue = np.log(small.transpose(2, 0, 1) / 255 + 0.06)
    np.testing.assert_allclose(planes[3], red - green, atol=1e-5)
    np.testing.assert_allclose(planes[4], green - blue, atol=1e-5)
    inside = small.max(2) >= 16
    for plane, of in zip(planes[5:], (red - green, green - blue, green), strict=True):
        np.testing.assert_allclose(plane, of - of[inside].mean(), atol=1e-5)
    np.testing.assert_array_equal(features(small), planes[None, :5])


@pytest.mark.parametrize(("level", "is_inside"), [(15, False), (16, True)])
def test_features_means_cover_field_of_view_only(level, is_inside):
    small = np.full((30, 40, 3), 100, np.uint8)
    small[:15] = level
    assert (abs(features(small, 8)[0, 7, 20, 20]) > 0.1) == is_inside


def corners(share: float, level: int = 5) -> np.ndarray:
    """Return a bright picture in whose four corners a share of the pixels is dark."""
    small = np.full((160, 320, 3), 120, np.uint8)
    for rows in (np.s_[:10], np.s_[-10:]):
        for columns in (np.s_[:20], np.s_[-20:]):
            part = np.full((200, 3), 120, np.uint8)
            part[: round(200 * share)] = level
            small[rows, columns] = part.reshape(10, 20, 3)
    return small


@pytest.mark.parametrize(
    ("share", "level", "is_round"),
    [(1.0, 5, True), (0.76, 5, True), (0.74, 5, False), (1.0, 15, True), (1.0, 16, False)],
)
def test_round_view_requires_three_quarters_dark_per_corner(share, level, is_round):
    assert round_view(corners(share, level)) == is_round


@pytest.mark.parametrize("corner", range(4))
def test_round_view_false_with_one_bright_corner(corner):
    small = corners(1.0)
    small[np.s_[:10] if corner < 2 else np.s_[-10:], np.s_[:20] if corner % 2 else np.s_[-20:]] = 90
    assert not round_view(small)


def test_along_edges_limits_logits_and_aligns_with_image_edges():
    small = np.full((40, 80, 3), (180, 60, 60), np.uint8)
    small[:, 41:] = 120
    logits = np.full((20, 40), -9.0, np.float32)
    logits[:, 20:] = 9.0
    found = along_edges(logits, features(small)[0])
    assert found.shape == (40, 80) and np.abs(found).max() <= CERTAIN + 0.3
    assert (found[:, :33] < -1.9).all() and (found[:, 49:] > 1.9).all()
    assert np.flatnonzero(found[20] > 0)[0] == 41, "the edge of colour is a pixel beside that of the logits"


def levels_with(side: int, left: int, value: int = 200) -> np.ndarray:
    levels = np.full((100, 100), 60, np.uint8)
    levels[40 : 40 + side, left : left + side] = value
    return levels


@pytest.mark.parametrize(
    ("side", "left", "value", "is_kept"),
    [
        (14, 50, 200, False), (15, 50, 200, True), (14, 0, 200, True), (14, 2, 200, True), (14, 3, 200, False),
        (14, 83, 200, False), (14, 84, 200, True), (14, 50, 129, False), (14, 50, 128, True),
    ],
)  # fmt: skip
def test_remove_inner_regions_border_distance_and_size_thresholds(side, left, value, is_kept):
    """200 of 10,000 pixels. A level of 128 is no tool, and stays as it is."""
    assert NETWORK_INNER_REGION * 100 * 100 == 200
    levels = levels_with(side, left, value)
    before = levels.copy()
    remove_inner_regions(levels, np.ones((100, 100), np.uint8))
    before[(before > 128) & (not is_kept)] = 0
    np.testing.assert_array_equal(levels, before)


def test_remove_inner_regions_keeps_region_at_view_border():
    view = np.zeros((100, 100), np.uint8)
    view[20:80, 20:80] = 1
    for left, is_kept in ((66, True), (62, False)):
        levels = levels_with(14, left)
        remove_inner_regions(levels, view)
        assert (levels > 128).any() == is_kept


@pytest.mark.parametrize(("logit", "is_tool"), [(-0.2, False), (0.2, True), (50.0, True)])
def test_network_finder_positive_logit_in_field_of_view_is_tool(monkeypatch, logit, is_tool):
    logits = lambda planes: np.full((80, 80), logit, np.float32)
    network = tools._Network(logits, (160, 160), 5)
    monkeypatch.setattr(tools, "_loaded", lambda *_: network)
    image = np.full((200, 300, 3), 120, np.uint8)
    found = tools.NetworkToolFinder().find(image)
    assert found.shape == (200, 300) and (found == 0).all() == is_tool == (not found.all())
    image[:60] = 0  # the surround is no tool
    assert tools.NetworkToolFinder().find(image)[:50].all()
