"""False colours of a renderer's outputs."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.choices import OUTPUTS
from gsplat_core.errors import InvalidSetting
from operators.layer_pictures import (
    CLASS_COLOURS,
    UNDECIDED,
    UNOBSERVED,
    OutputPictures,
    class_colours,
    flow_colours,
    normal_colours,
)  # fmt: skip

SEEN = np.ones((2, 3), np.float32)


def field(*vector: float) -> np.ndarray:
    return np.broadcast_to(np.asarray(vector, np.float32), (2, 3, len(vector)))


@pytest.mark.parametrize(
    ("normal", "colour"),
    [
        ((0, 0, -1), (128, 128, 255)),
        ((1, 0, 0), (255, 128, 128)),
        ((0, -1, 0), (128, 255, 128)),
        ((0, 0, 0), (0, 0, 0)),
    ],
)
def test_normal_colours_map_directions_to_rgb(normal, colour):
    assert normal_colours(field(*normal))[1, 1].tolist() == list(colour)


@pytest.mark.parametrize(
    ("flow", "colour"),
    [((0, 0), (255, 255, 255)), ((2, 0), (255, 0, 0)), ((-2, 0), (0, 255, 255)), ((1, 0), (255, 128, 128))],
)
def test_flow_colours_hue_follows_direction(flow, colour):
    assert flow_colours(field(*flow), 2.0)[0, 0].tolist() == list(colour)


def test_flow_colours_of_small_flow_are_pale():
    assert flow_colours(field(0.02, 0), 0.02).min() > 230


def test_class_colours_use_palette_of_largest_score():
    assert class_colours(field(0.0, 3.0, 1.0))[0, 0].tolist() == CLASS_COLOURS[1].tolist()
    with pytest.raises(InvalidSetting, match="train with --losses semantics"):
        class_colours(np.zeros((2, 3, 0), np.float32))


def test_pixels_without_class_or_depth_have_marker_colour():
    assert class_colours(np.zeros((2, 3, 4), np.float32))[0, 0].tolist() == list(UNDECIDED)
    depth = np.full((30, 40), 50, np.float32)
    depth[:, 20:] = 0
    image = OutputPictures().picture("median_depth", depth, np.full((30, 40), 0.4, np.float32))
    assert (image[:, 20:] == UNOBSERVED).all(-1).mean() > 0.5 and not (image[:, :20] == UNOBSERVED).all(-1).any()


@pytest.mark.parametrize("name", ["depth", *OUTPUTS])
def test_every_output_picture_marks_unobserved_pixels(name):
    channels = {"semantics": 4}.get(name) or OUTPUTS[name].channels if name != "depth" else 1
    values = np.full((30, 40) if channels == 1 else (30, 40, channels), 0.5, np.float32)
    alpha = np.ones((30, 40), np.float32)
    alpha[:, 20:] = 0
    image = OutputPictures().picture(name, values, alpha)
    assert image.shape == (30, 40, 3) and image.dtype == np.uint8
    assert (image[:, 20:] == UNOBSERVED).all(-1).mean() > 0.5
    assert not (image[:, :20] == UNOBSERVED).all(-1).any()


def test_ray_depth_picture_shows_near_surfaces_warm():
    depth = np.broadcast_to(np.linspace(50, 80, 32, dtype=np.float32), (8, 32)).copy()
    image = OutputPictures().picture("ray_depth", depth, np.ones_like(depth)).astype(int)
    assert image[0, 1, 0] > image[0, 1, 2] and image[0, -2, 2] > image[0, -2, 0]


def test_spread_picture_keeps_range_across_pictures():
    pictures = OutputPictures()
    first = pictures.picture("spread", SEEN, SEEN)
    second = pictures.picture("spread", 0.5 * SEEN, SEEN)
    assert (first != second).any(), "half the spread has another colour than all of it before"
