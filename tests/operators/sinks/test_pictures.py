"""Colours that mean something: error, depth, tools."""

from __future__ import annotations

import numpy as np

from operators.sinks.pictures import depth_map, depth_range, error_map

GREY = (70, 74, 80)


def test_no_error_is_dark_and_much_error_is_bright(rendered):
    assert error_map(rendered(0, offset=0)).max() < 10
    assert error_map(rendered(0, offset=32)).mean() > 200


def test_tools_are_grey_because_they_are_not_scored(rendered, frame):
    mask = np.ones((16, 24), np.uint8)
    mask[2, 3] = 0
    picture = error_map(rendered(frame=frame(0, mask=mask)))
    assert tuple(picture[2, 3]) == GREY and tuple(picture[2, 4]) != GREY


def test_near_is_bright_far_is_dark_unknown_is_grey(rendered):
    depth = np.linspace(40, 80, 24, dtype=np.float32)[None].repeat(16, 0)
    depth[0] = 0
    shown = rendered(depth=depth)
    picture = depth_map(shown).astype(int).sum(axis=2)
    assert picture[5, 0] > picture[5, 23]
    assert (depth_map(shown)[0] == GREY).all()
    near, far = depth_range(shown)
    assert 40 <= near < 42 and 78 < far <= 80


def test_a_flat_scene_is_one_colour_and_an_empty_one_has_no_range(rendered):
    flat = rendered(depth=np.full((16, 24), 60, np.float32))
    assert np.ptp(depth_map(flat).reshape(-1, 3), axis=0).max() == 0
    assert depth_range(rendered(depth=np.zeros((16, 24), np.float32))) is None
