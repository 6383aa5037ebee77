"""Grey regions become tools by size, colour, brightness and outline; tested on drawn planes with known answers."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.endoscope.tools import Regions, mean_level, tool_regions, whole_tools

HEIGHT, WIDTH = 100, 120
TISSUE, TOOL = 0.5, 0.0


def view(redness, brightness=None, inside=None, previous=None):
    """Planes of a picture in which redness below 0.2 is grey; its brightness is 120 and brighter in two rows."""
    if brightness is None:
        brightness = np.full((HEIGHT, WIDTH), 120, np.uint8)
        brightness[70:72] = 200
    inside = np.ones((HEIGHT, WIDTH), np.uint8) if inside is None else inside
    levels = np.bincount(brightness[inside > 0], minlength=256).astype(np.float64)
    return Regions(redness.astype(np.float32), 0.2, brightness, inside, levels, previous)


def patch(top, left, high, wide):
    where = np.zeros((HEIGHT, WIDTH), bool)
    where[top : top + high, left : left + wide] = True
    return where


def is_found(where, tissue=TISSUE, tool=TOOL, brightness=None, known=False):
    """Return True if a grey patch is found exactly, and False if nothing is found."""
    redness = np.where(where, tool, tissue)
    found = tool_regions(view(redness, brightness, previous=where.astype(np.uint8) if known else None))
    if found.any():
        np.testing.assert_array_equal(found, where)
    return bool(found.any())


@pytest.mark.parametrize(
    ("where", "known", "found"),
    [
        (patch(30, 0, 6, 10), False, True),
        (patch(30, 110, 6, 10), False, True),
        (patch(0, 40, 6, 10), False, True),
        (patch(94, 40, 6, 10), False, True),
        (patch(30, 0, 4, 4), False, False),
        (patch(30, 0, 4, 4), True, False),
        (patch(30, 0, 4, 8), False, False),
        (patch(30, 0, 4, 8), True, True),
        (patch(40, 50, 6, 10), False, False),
        (patch(40, 50, 14, 14), False, True),
        (patch(40, 50, 10, 10), False, False),
        (patch(40, 50, 10, 10), True, True),
    ],
)
def test_tool_regions_minimum_size_by_border_contact_and_known_tool(where, known, found):
    assert is_found(where, known=known) == found


@pytest.mark.parametrize(("level", "found"), [(10, False), (15, False), (25, True), (90, True)])
def test_tool_regions_ignore_colour_of_nearly_black_pixels(level, found):
    where = patch(30, 0, 20, 30)
    brightness = np.where(where, level, 120).astype(np.uint8)
    assert is_found(where, brightness=brightness) == found


@pytest.mark.parametrize(("surroundings", "level", "found"), [(120, 250, False), (60, 100, False)])
def test_tool_regions_ignore_inner_glare_at_any_exposure(surroundings, level, found):
    where = patch(40, 50, 16, 16)
    brightness = np.where(where, level, surroundings).astype(np.uint8)
    assert is_found(where, brightness=brightness) == found


def test_tool_regions_tolerate_glare_at_border_or_on_part_of_tool():
    at_border = patch(40, 0, 16, 16)
    assert is_found(at_border, brightness=np.where(at_border, 250, 120).astype(np.uint8))
    inside = patch(40, 50, 16, 16)
    assert is_found(inside, brightness=np.where(patch(42, 50, 4, 16), 250, 120).astype(np.uint8))


def test_tool_regions_glare_threshold_relative_to_brightest_pixels():
    where = patch(40, 50, 16, 16)
    for level, found in ((235, False), (205, True)):
        brightness = np.where(where, level, 120).astype(np.uint8)
        brightness[:2] = 250  # 2 % of the picture
        assert is_found(where, brightness=brightness) == found


@pytest.mark.parametrize(
    ("step", "known", "found"), [(0.3, False, False), (0.3, True, True), (0.22, True, False), (0.45, False, True)]
)
def test_tool_regions_outline_contrast_threshold_lower_for_known_tool(step, known, found):
    assert is_found(patch(30, 0, 20, 30), tissue=step, known=known) == found


def test_tool_regions_ignore_grey_tissue_without_edge():
    redness = np.tile(np.linspace(0, 0.8, WIDTH), (HEIGHT, 1))
    assert not tool_regions(view(redness)).any()


@pytest.mark.parametrize(
    ("share", "known", "found"),
    [(0.0, False, False), (0.3, False, False), (0.3, True, True), (0.2, True, False), (0.4, False, True)],
)
def test_tool_regions_clearly_grey_share_threshold_lower_for_known_tool(share, known, found):
    where = patch(30, 0, 20, 30)
    clearly = patch(30, 0, round(20 * share), 30)
    redness = np.where(clearly, 0.05, np.where(where, 0.16, 0.7))
    seen = tool_regions(view(redness, previous=where.astype(np.uint8) if known else None))
    np.testing.assert_array_equal(seen, where if found else 0 * where)


def disc(radius):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return ((y - 49.5) ** 2 + (x - 59.5) ** 2 < radius**2).astype(np.uint8)


def test_tool_regions_rim_of_view_counts_as_border_and_not_as_outline():
    inside = disc(45)
    black = np.where(inside > 0, 120, 0).astype(np.uint8)
    assert not tool_regions(view(np.where(inside, TISSUE, 0.0), black, inside)).any()
    # The field of view has 6,360 pixels: 40 are enough at its rim alone.
    for left, found in ((16, True), (56, False)):
        where = patch(46, left, 6, 7) & (inside > 0)
        seen = tool_regions(view(np.where(where, TOOL, np.where(inside, TISSUE, 0.0)), black, inside))
        np.testing.assert_array_equal(seen, where if found else 0 * where)
    # Grey tissue that fades inwards has an edge only at the rim, where the picture ends.
    _, x = np.mgrid[:HEIGHT, :WIDTH]
    fading = np.where(inside > 0, np.clip((x - 15) / 90, 0, 1), 1.0)
    assert not tool_regions(view(fading, black, inside)).any()


def test_mean_level_equals_mean_of_histogram():
    levels = np.zeros(256)
    levels[[10, 200]] = 3, 1
    assert mean_level(levels) == pytest.approx((3 * 10 + 200) / 4) and mean_level(np.zeros(256)) == 0


@pytest.mark.parametrize(("redness", "columns"), [(0.3, 22), (0.38, 21)])
def test_whole_tools_adds_edge_pixels_nearer_to_tool_and_one_pixel(redness, columns):
    plane = np.full((HEIGHT, WIDTH), 0.5)
    plane[:, :20], plane[:, 20] = 0.1, redness
    found = (plane < 0.2).astype(np.uint8)
    np.testing.assert_array_equal(
        whole_tools(view(plane), found), np.arange(WIDTH)[None] < np.full((HEIGHT, 1), columns)
    )


def test_whole_tools_grows_four_pixels_at_most_within_field_of_view():
    plane = np.full((HEIGHT, WIDTH), 0.5)
    plane[:, :26], plane[:, 26:40] = 0.1, 0.05
    grown = whole_tools(view(plane), (np.arange(WIDTH)[None] < np.full((HEIGHT, 1), 26)).astype(np.uint8))
    np.testing.assert_array_equal(np.flatnonzero(grown[50]), np.arange(31))
    nothing = np.zeros((HEIGHT, WIDTH), np.uint8)
    assert not whole_tools(view(plane), nothing).any()
    inside = np.ones((HEIGHT, WIDTH), np.uint8)
    inside[:, 26:] = 0
    kept_in = whole_tools(
        view(plane, inside=inside), (np.arange(WIDTH)[None] < np.full((HEIGHT, 1), 24)).astype(np.uint8)
    )
    assert not kept_in[:, 27:].any()


def test_whole_tools_closes_small_gap():
    plane = np.full((HEIGHT, WIDTH), 0.5)
    found = np.zeros((HEIGHT, WIDTH), np.uint8)
    found[40:60, 20:40] = found[40:60, 43:60] = 1
    plane[found > 0] = 0.1
    assert whole_tools(view(plane), found)[42:58, 20:60].all()
