"""False colours of depth and confidence, and the marks of what was never observed."""

from __future__ import annotations

import numpy as np
import pytest

from operators.layer_pictures import (
    UNOBSERVED,
    UNOBSERVED_LINE,
    VIRTUAL,
    DepthColours,
    confidence_picture,
    mark_unobserved,
    mark_virtual,
)

OPAQUE = np.ones((40, 60), np.float32)
RAMP = np.broadcast_to(np.linspace(40, 80, 60, dtype=np.float32), (40, 60)).copy()


def rgb(colour: str) -> list[int]:
    return [int(colour[place : place + 2], 16) for place in (1, 3, 5)]


def test_depth_colours_near_is_warm_and_legend_matches():
    image, legend = DepthColours().picture(RAMP, OPAQUE, metric=True)
    assert legend.unit == "mm" and 40 <= legend.low < 42 and 78 < legend.high <= 80
    red, _, blue = image[20, 1].astype(int)
    assert red > blue + 50
    for column, stop in ((0, legend.stops[0]), (59, legend.stops[-1])):
        assert np.abs(image[20, column].astype(int) - rgb(stop)).max() <= 2
    middle = legend.stops[len(legend.stops) // 2]
    assert np.abs(image[20, 30].astype(int) - rgb(middle)).max() <= 25


def test_depth_colours_of_relative_depth_are_shares_of_median():
    _, legend = DepthColours().picture(RAMP, OPAQUE, metric=False)
    assert legend.unit == "relative" and legend.low == pytest.approx(41 / 60, abs=0.02)
    assert legend.said()["stops"] == list(legend.stops)


def test_depth_colours_range_follows_slowly_and_resets_for_new_scene():
    colours = DepthColours()
    colours.picture(RAMP, OPAQUE, metric=True)
    _, slow = colours.picture(RAMP + 10, OPAQUE, metric=True)
    assert 41 < slow.low < 44
    _, other = colours.picture(RAMP * 5, OPAQUE, metric=True)
    assert other.low > 195


def test_depth_colours_range_has_minimum_width():
    _, legend = DepthColours().picture(50 + RAMP * 1e-3, OPAQUE, metric=True)
    assert legend.high - legend.low == pytest.approx(0.05 * 50, rel=0.01)


@pytest.mark.parametrize("nothing", [np.zeros_like(RAMP), np.full_like(RAMP, np.nan)])
def test_depth_colours_without_depth_are_all_unobserved(nothing):
    image, legend = DepthColours().picture(nothing, np.zeros_like(OPAQUE), metric=True)
    assert {tuple(colour) for colour in image.reshape(-1, 3).tolist()} == {UNOBSERVED, UNOBSERVED_LINE}
    assert np.isfinite([legend.low, legend.high]).all()


def test_mark_unobserved_changes_only_unobserved_pixels():
    alpha = OPAQUE.copy()
    alpha[:, :15] = 0.05
    alpha[0, 20] = np.nan
    image = np.full((40, 60, 3), 200, np.uint8)
    assert mark_unobserved(image, alpha) == pytest.approx((40 * 15 + 1) / 2400)
    seen = image[:, 21:]
    assert (seen == 200).all()
    assert not (image[:, :15] == 200).any() and not (image[0, 20] == 200).any()


def test_confidence_picture_matches_legend_colours():
    image, legend = confidence_picture(np.where(RAMP < 60, 0, 1).astype(np.float32), OPAQUE)
    assert (legend.unit, legend.low, legend.high) == ("confidence", 0, 1)
    assert image[0, 0].tolist() == rgb(legend.stops[0]) and image[0, 59].tolist() == rgb(legend.stops[-1])


@pytest.mark.parametrize("size", [(2, 300), (300, 2), (256, 320)])
def test_mark_virtual_draws_border_at_any_size(size):
    image = np.zeros((*size, 3), np.uint8)
    mark_virtual(image, "VIRTUAL VIEW az +10")
    assert tuple(image[0, -1]) == VIRTUAL
