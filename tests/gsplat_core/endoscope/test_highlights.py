"""`without_highlights`: reflections are excluded; merely bright tissue is kept."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope.highlights import without_highlights
from tests.gsplat_core.endoscope.clips import PLACES, clip, texture

SPOTS = [(40, 50, 6), (90, 100, 3), (120, 20, 9)]


def with_spots(image, colour=(255, 252, 250)):
    image = image.copy()
    for x, y, radius in SPOTS:
        cv2.circle(image, (x, y), radius, colour, -1, cv2.LINE_AA)
    return image


def spots(height=128, width=160, grown=0):
    field = np.zeros((height, width), np.uint8)
    for x, y, radius in SPOTS:
        cv2.circle(field, (x, y), radius + grown, 1, -1)
    return field.astype(bool)


def test_without_highlights_excludes_reflections_with_narrow_rim():
    kept = without_highlights(with_spots(texture(1, 1)[0])).astype(bool)
    assert not (kept & spots()).any()
    assert kept[~spots(grown=4)].all()


def test_without_highlights_returns_none_without_reflections():
    assert without_highlights(texture(1, 1)[0]) is None


def test_without_highlights_keeps_saturated_colour():
    assert without_highlights(with_spots(texture(1, 1)[0], (255, 235, 60))) is None


def test_without_highlights_keeps_uniformly_bright_pale_tissue():
    pale = np.clip(texture(2, 1)[0].astype(np.float32) * 0.12 + np.array([225, 190, 180]), 0, 255).astype(np.uint8)
    assert without_highlights(pale) is None


def test_without_highlights_keeps_overexposed_half():
    image = texture(3, 1)[0].copy()
    image[:, 60:] = 250
    kept = without_highlights(image)
    assert kept is None or kept[:, 80:].all()


def test_without_highlights_white_image_returns_none():
    assert without_highlights(np.full((64, 64, 3), 255, np.uint8)) is None


def test_without_highlights_independent_of_image_size():
    image = with_spots(texture(1, 1)[0])
    large = cv2.resize(image, (1600, 1280), interpolation=cv2.INTER_CUBIC)
    small, found = (1 - without_highlights(each) for each in (image, large))
    again = cv2.resize(small, (1600, 1280), interpolation=cv2.INTER_NEAREST)
    assert (again & found).sum() / (again | found).sum() > 0.8


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_without_highlights_in_recordings_removes_small_white_areas_only(recordings_dir, name):
    for image in clip(recordings_dir, name)[::10]:
        kept = without_highlights(image)
        assert kept is not None and 0.95 < kept.mean() < 1
        whitest = image.min(axis=2) >= 215
        # What is nearly white and small goes; of a large overexposed wall (sinus, colon) nothing must.
        if name in ("cutting", "heart"):
            assert (kept[whitest] == 0).mean() > 0.85


@pytest.mark.recordings
def test_without_highlights_keeps_overexposed_wall_of_sinus(recordings_dir):
    for image in clip(recordings_dir, "sinus")[20::5]:
        assert image[300, 480].min() > 180
        assert without_highlights(image)[260:360, 440:500].mean() > 0.9


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 2**32), st.booleans())
def test_without_highlights_accepts_images_of_any_size(height, width, seed, bright):
    rng = np.random.default_rng(seed)
    kept = without_highlights(rng.integers(128 if bright else 0, 256, (height, width, 3), np.uint8))
    assert kept is None or (kept.shape == (height, width) and kept.max() <= 1)


@pytest.mark.parametrize("shape", [(1, 3000), (3000, 1), (801, 799)])
def test_without_highlights_accepts_elongated_images(shape):
    image = np.zeros((*shape, 3), np.uint8)
    image[shape[0] // 2, shape[1] // 2] = 255
    kept = without_highlights(image)
    assert kept is None or kept.shape == shape


def spotted(colour, tissue=(200, 150, 150), size=(256, 320), side=9):
    """Even tissue with one square of another colour in its middle."""
    image = np.full((*size, 3), tissue, np.uint8)
    y, x = size[0] // 2, size[1] // 2
    image[y : y + side, x : x + side] = colour
    return image


@pytest.mark.parametrize(
    ("colour", "tissue", "found"),
    [
        ((240, 200, 200), (200, 150, 150), True),
        ((200, 240, 200), (200, 150, 150), True),
        ((200, 200, 240), (200, 150, 150), True),
        ((230, 200, 200), (200, 150, 150), False),
        ((255, 180, 255), (180, 90, 90), True),
        ((255, 160, 255), (180, 90, 90), False),
        ((160, 255, 255), (180, 90, 90), False),
        ((255, 255, 160), (180, 90, 90), False),
        ((240, 185, 185), (200, 150, 150), True),
        ((240, 175, 175), (200, 150, 150), False),
    ],
)
def test_without_highlights_colour_and_contrast_thresholds(colour, tissue, found):
    assert (without_highlights(spotted(colour, tissue)) is not None) == found


@pytest.mark.parametrize(("size", "grown"), [((64, 80), 1), ((512, 640), 2), ((64, 640), 2), ((640, 64), 2)])
def test_without_highlights_grows_regions_by_two_of_640_pixels(size, grown):
    kept = without_highlights(spotted(255, (180, 90, 90), size))
    rows, columns = np.nonzero(kept == 0)
    assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == (9 + 2 * grown, 9 + 2 * grown)
    assert rows.min() == size[0] // 2 - grown and columns.min() == size[1] // 2 - grown


@pytest.mark.parametrize(("apart", "found"), [(12, True), (7, False)])
def test_without_highlights_keeps_dense_white_dots(apart, found):
    """Dots of 4 x 4 pixels cover a ninth of the picture 12 apart, and a third 7 apart."""
    image = np.full((256, 320, 3), (180, 20, 20), np.uint8)
    for y in range(0, 256, apart):
        for x in range(0, 320, apart):
            image[y : y + 4, x : x + 4] = 255
    assert (without_highlights(image) is not None) == found


def test_without_highlights_keeps_pale_tissue_in_black_surround():
    image = np.zeros((256, 320, 3), np.uint8)
    cv2.circle(image, (160, 128), 80, (240, 190, 190), -1)
    kept, inside = without_highlights(image), cv2.circle(np.zeros((256, 320), np.uint8), (160, 128), 70, 1, -1)
    assert kept is None or kept[inside > 0].all()


@pytest.mark.parametrize("level", [250, 254, 255])
@pytest.mark.parametrize("size", [(256, 320), (1024, 1280)])
def test_without_highlights_keeps_middle_of_wide_white_area(level, size):
    unit = size[0] // 256
    kept = without_highlights(spotted(level, (180, 90, 90), size, side=80 * unit))
    rows, columns = (slice(side // 2 + 30 * unit, side // 2 + 50 * unit) for side in size)
    assert kept is None or kept[rows, columns].all()
    kept = without_highlights(spotted(level, (180, 90, 90), size, side=15 * unit))
    rows, columns = (slice(side // 2, side // 2 + 15 * unit) for side in size)
    assert not kept[rows, columns].any()


@pytest.mark.parametrize("level", [226, 240, 254])
def test_without_highlights_keeps_saturated_spots_on_overexposed_tissue(level):
    """A saturated level exceeds its surroundings by less than the required 30 levels."""
    assert without_highlights(spotted(255, (level, level, level))) is None
