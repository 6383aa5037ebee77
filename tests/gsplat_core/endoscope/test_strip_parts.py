"""Overlays at the borders: schedule, temporal means, edges of strips and text, in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gsplat_core.endoscope import artefacts
from gsplat_core.endoscope.artefacts import StripDetector, _Band, _text


class Fixed:
    """Band that marks some rows and notes in which frames it was examined."""

    def __init__(self) -> None:
        self.rows: slice | None = None
        self.examined: list[int] = []
        self.frame = 0

    def add(self, image: np.ndarray) -> None:
        self.examined.append(self.frame)

    def mark(self, drawn: np.ndarray) -> None:
        if self.rows is not None:
            drawn[self.rows] = True


def detector_with(bands: list[Fixed], shape: tuple[int, int] = (100, 120)) -> tuple[StripDetector, np.ndarray]:
    detector, image = StripDetector(), np.zeros((*shape, 3), np.uint8)
    detector._start(image.shape)
    detector._bands = bands  # type: ignore[assignment]
    return detector, image


def test_strip_detector_examines_borders_in_turn_and_needs_two_decisions() -> None:
    bands = [Fixed() for _ in range(4)]
    detector, image = detector_with(bands)
    bands[2].rows = slice(90, None)
    masks = []
    for frame in range(160):
        for band in bands:
            band.frame = frame
        if frame == 100:
            bands[2].rows = None
        masks.append(detector.observe(image))
    assert [band.examined for band in bands] == [list(range(border, 160, 4)) for border in range(4)]
    assert {index for index, mask in enumerate(masks) if mask is not None} == set(range(79, 119))
    expected = np.ones((100, 120), np.uint8)
    expected[90:] = 0
    np.testing.assert_array_equal(masks[79], expected)


@pytest.mark.parametrize(("shift", "is_found"), [(2, True), (3, False)])
def test_strip_decisions_agree_within_two_pixels(shift: int, is_found: bool) -> None:
    bands = [Fixed() for _ in range(4)]
    detector, image = detector_with(bands)
    for round_ in range(2):
        bands[0].rows = slice(50 + shift * round_, 51 + shift * round_)
        for _ in range(40):
            detector.observe(image)
    assert (detector.mask is not None) == is_found
    if is_found:
        assert detector.mask is not None
        assert np.flatnonzero((detector.mask == 0).any(1)).tolist() == [52]


def test_strip_mask_array_reused_until_overlays_or_size_change() -> None:
    bands = [Fixed() for _ in range(4)]
    detector, image = detector_with(bands)
    bands[0].rows = slice(0, 5)
    masks = [detector.observe(image) for _ in range(160)]
    assert masks[-1] is masks[79] is not None
    bands[0].rows = slice(0, 7)
    for _ in range(80):
        mask = detector.observe(image)
    assert mask is not masks[79] and mask is not None and (mask[:7] == 0).all()
    assert detector.observe(np.zeros((60, 80, 3), np.uint8)) is None


def test_strip_detector_subsamples_large_image_and_returns_full_size_mask() -> None:
    bands = [Fixed() for _ in range(4)]
    side = 2 * artefacts.LONG_SIDE_PX
    detector, image = detector_with(bands, (side // 2, side))
    assert detector._small == (side // 4, side // 2)
    bands[0].rows = slice(3, 4)
    for _ in range(80):
        mask = detector.observe(image)
    assert mask is not None and mask.shape == (side // 2, side)
    assert np.flatnonzero((mask == 0).all(1)).tolist() == [6, 7]


@pytest.mark.parametrize(("side", "has_bands"), [(artefacts.SMALLEST_PX, True), (artefacts.SMALLEST_PX - 1, False)])
def test_strip_detector_skips_small_images(side: int, has_bands: bool) -> None:
    detector = StripDetector()
    for shape in ((side, 200), (200, side)):
        detector.observe(np.zeros((*shape, 3), np.uint8))
        assert bool(detector._bands) == has_bands


def test_strip_band_depth_is_twelfth_of_side_and_eight_pixels_at_least() -> None:
    detector = StripDetector()
    detector.observe(np.zeros((200, 300, 3), np.uint8))
    assert [band._depth_px for band in detector._bands] == [16, 24, 16, 24]
    detector.observe(np.zeros((80, 90, 3), np.uint8))
    assert [band._depth_px for band in detector._bands] == [8] * 4


@pytest.mark.parametrize("turns", range(4))
def test_band_marks_own_border(turns: int) -> None:
    band = _Band(turns, 6)
    plane = np.zeros((30, 40), bool)
    band._of(plane)[-2:] = True
    expected = np.zeros_like(plane)
    expected[[np.s_[-2:], np.s_[:, :2], np.s_[:2], np.s_[:, -2:]][turns]] = True  # below, left, above, right
    np.testing.assert_array_equal(plane, expected)


def levels(*columns: int) -> np.ndarray:
    """Return a picture whose left part is black and whose right part has a level from column 5 on; one for each level."""
    made = np.zeros((len(columns), 20, 10, 3), np.uint8)
    for image, level in zip(made, columns, strict=True):
        image[:, 5:] = level
    return made


def test_band_gradient_means_cover_up_to_forty_frames() -> None:
    rng = np.random.default_rng(0)
    values = rng.integers(0, 200, 40)
    band = _Band(0, 8)
    for image in levels(*values):
        band.add(image)
    assert band._mean is not None
    assert band._mean[1, :, 5] == pytest.approx(values.mean(), rel=1e-4)
    assert np.abs(band._mean[0]).max() == 0 and np.abs(np.delete(band._mean[1], 5, 1)).max() == 0
    before, deviation = float(band._mean[1, 0, 5]), float(band._deviation[1, 0, 5])
    band.add(levels(200)[0])
    assert band._mean[1, 0, 5] == pytest.approx(before + (200 - before) / 40, rel=1e-4)
    assert band._deviation[1, 0, 5] == pytest.approx(deviation + (200 - before - deviation) / 40, rel=1e-4)


@pytest.mark.parametrize(("spread", "is_marked"), [(4, True), (60, False)])
def test_band_ignores_moving_edge(spread: int, is_marked: bool) -> None:
    """A horizontal step of 100 levels with a deviation of `spread`; it must be 2.5 times as large."""
    band, drawn = _Band(0, 20), np.zeros((60, 80), bool)
    for frame in range(40):
        image = np.full((60, 80, 3), 50, np.uint8)
        image[50:] = 150 + (spread if frame % 2 else -spread)
        band.add(image)
    band.mark(drawn)
    assert drawn[50:].all() == is_marked == drawn.any()


def edges(length: int, strength: float = 12.0, steadiness: float = 3.0, at: int = 12, gap: int = 0) -> tuple[Any, Any]:
    """Return an edge in a band of 20 x 100 pixels."""
    values = np.zeros((2, 20, 100), np.float32)
    values[0, at, 10 : 10 + length], values[1, at, 10 : 10 + length] = strength, steadiness
    if gap:
        values[:, at, 10 + length // 2 : 10 + length // 2 + gap] = 0
    return values[0], values[1]


def below(first: int, columns: slice) -> np.ndarray:
    expected = np.zeros((20, 100), bool)
    expected[first:, columns] = True
    return expected


@pytest.mark.parametrize(
    ("edge", "columns"),
    [
        (edges(15), slice(10, 25)), (edges(14), slice(0, 0)),
        (edges(60), slice(None)), (edges(59), slice(10, 69)),
        (edges(30, strength=10.0), slice(10, 40)), (edges(30, strength=9.9), slice(0, 0)),
        (edges(30, steadiness=2.5), slice(10, 40)), (edges(30, steadiness=2.4), slice(0, 0)),
        (edges(28, gap=8), slice(10, 38)), (edges(28, gap=9), slice(0, 0)),
    ],
    ids=str,
)  # fmt: skip
def test_band_strip_requires_unbroken_edge(edge: Any, columns: slice) -> None:
    """The strip includes one more row, because edges may be tilted by a pixel."""
    np.testing.assert_array_equal(_Band(0, 20)._strips(*edge), below(11, columns))


def text(width: int, height: int, strength: float = 25.0, steadiness: float = 5.0) -> tuple[Any, Any]:
    values = np.zeros((2, 2, 30, 200), np.float32)
    values[0, 1, 10 : 10 + height, 50 : 50 + width] = strength
    values[1, 1, 10 : 10 + height, 50 : 50 + width] = steadiness
    return values[0], values[1]


@pytest.mark.parametrize(
    ("given", "is_text"),
    [
        (text(4, 3), True), (text(3, 3), False), (text(4, 2), False),
        (text(8, 6, strength=24.9), False), (text(8, 6, steadiness=4.9), False), (text(8, 6), True),
    ],
    ids=str,
)  # fmt: skip
def test_text_minimum_width_height_and_strength(given: Any, is_text: bool) -> None:
    found = _text(*given)
    assert found.any() == is_text
    if is_text:  # with two pixels around
        rows, columns = (np.flatnonzero(found.any(axis)) for axis in (1, 0))
        size = np.argwhere(given[0][1] > 0).max(0)
        assert (rows[0], columns[0]) == (8, 48) and (rows[-1], columns[-1]) == (size[0] + 2, size[1] + 2)


@pytest.mark.parametrize(("gap", "height"), [(6, True), (7, False)])
def test_text_joins_letters_up_to_six_pixels_apart(gap: int, height: bool) -> None:
    strength = np.zeros((2, 30, 200), np.float32)
    for start in (50, 50 + 3 + gap):  # each letter is too narrow alone
        strength[0, 10:20, start : start + 3] = 30
    assert _text(strength, strength).any() == height


def test_text_ignores_sparse_outline() -> None:
    """A diagonal line fills a small part of its bounding box."""
    strength = np.zeros((2, 40, 200), np.float32)
    for k in range(40):
        strength[0, k, 50 + 2 * k : 52 + 2 * k] = 30
    assert not _text(strength, strength).any()
