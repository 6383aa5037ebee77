"""False colours of error, depth and tools."""

from __future__ import annotations

import numpy as np
import pytest

from operators.sinks.video import CAPTION_HEIGHT_PX, depth_map, depth_range, error_map, fitted, side_by_side

GREY = (70, 74, 80)


def test_error_map_brightness_follows_error(rendered):
    assert error_map(rendered(0, offset=0)).max() < 10
    assert error_map(rendered(0, offset=32)).mean() > 200


def test_error_map_shows_tools_grey(rendered, frame):
    mask = np.ones((16, 24), np.uint8)
    mask[2, 3] = 0
    picture = error_map(rendered(frame=frame(0, mask=mask)))
    assert tuple(picture[2, 3]) == GREY and tuple(picture[2, 4]) != GREY


def test_depth_map_shows_near_bright_far_dark_and_unknown_grey(rendered):
    depth = np.linspace(40, 80, 24, dtype=np.float32)[None].repeat(16, 0)
    depth[0] = 0
    shown = rendered(depth=depth)
    picture = depth_map(shown).astype(int).sum(axis=2)
    assert picture[5, 0] > picture[5, 23]
    assert (depth_map(shown)[0] == GREY).all()
    near, far = depth_range(shown)
    assert 40 <= near < 42 and 78 < far <= 80


def test_depth_map_of_flat_scene_has_one_colour(rendered):
    flat = rendered(depth=np.full((16, 24), 60, np.float32))
    assert np.ptp(depth_map(flat).reshape(-1, 3), axis=0).max() == 0
    assert depth_range(rendered(depth=np.zeros((16, 24), np.float32))) is None


@pytest.mark.parametrize(
    ("size", "wanted", "box"),
    [
        ((10, 20), (30, 40), (5, 25, 0, 40)),
        ((20, 10), (40, 30), (0, 40, 5, 25)),
        ((10, 10), (10, 10), (0, 10, 0, 10)),
        ((100, 1), (10, 10), (0, 10, 4, 5)),
    ],
)
def test_fitted_picture_keeps_aspect_ratio(size, wanted, box):
    canvas = fitted(np.full((*size, 3), 200, np.uint8), *wanted)
    bright = (canvas == 200).all(-1)
    top, bottom, left, right = box
    assert canvas.shape == (*wanted, 3) and bright[top:bottom, left:right].all()
    assert bright.sum() == (bottom - top) * (right - left) and (canvas[~bright] == (17, 20, 24)).all()


@pytest.mark.parametrize(("width", "zoom"), [(24, 14), (319, 2), (320, 1), (321, 1)])
def test_side_by_side_enlarges_small_pictures_by_integer_factor(rendered, frame, width, zoom):
    image = np.full((16, width, 3), 90, np.uint8)
    pair = side_by_side(rendered(frame=frame(image=image)))
    assert pair.shape == (CAPTION_HEIGHT_PX + 16 * zoom, 2 * width * zoom, 3)
    below = pair[CAPTION_HEIGHT_PX:]
    assert (below[:, : zoom * width - 1] == 90).all() and (below[:, zoom * width + 1 :] == 92).all()
    assert (below[:, zoom * width - 1 : zoom * width + 1] == (17, 20, 24)).all()


def test_depth_range_is_2nd_to_98th_percentile_of_known_depth(rendered):
    depth = np.arange(1, 385, dtype=np.float32).reshape(16, 24)
    alpha = np.full((16, 24), 0.51, np.float32)
    known = np.arange(3, 383)
    depth[0, :2], alpha[-1, -2:] = (0, np.inf), 0.5
    assert depth_range(rendered(depth=depth, alpha=alpha)) == pytest.approx(np.percentile(known, (2, 98)))
    assert depth_range(rendered(depth=np.zeros_like(depth), alpha=alpha)) is None
