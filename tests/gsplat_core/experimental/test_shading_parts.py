"""Parts of the shading of a picture, in closed form: exposure, margins, averages over cells, pigment and limits."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.experimental import shading
from gsplat_core.experimental.shading import LEAST_DETAIL, LEAST_KNOWN, Change, SmallPicture, log_diffuse
from gsplat_core.scene.frames import Frame


def small(levels: np.ndarray, usable: np.ndarray | None = None) -> SmallPicture:
    weight = np.ones(levels.shape[:2], np.float32) if usable is None else usable.astype(np.float32)
    return SmallPicture(levels, weight, np.ones(levels.shape[:2], np.uint8))


def test_log_light_inverts_srgb_curve_and_shoulder():
    light = np.array([0.01, 0.1, 0.3, 0.8])
    linear = (1 - np.exp(-0.8 * light)) / 0.8
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    levels = np.rint(255 * curve).astype(int)
    np.testing.assert_allclose(np.exp(shading._LOG_LIGHT[levels]), light, rtol=0.05)
    assert np.isfinite(shading._LOG_LIGHT).all() and (np.diff(shading._LOG_LIGHT) >= 0).all()
    assert shading._LOG_LIGHT[0] == pytest.approx(np.log(1e-4)), "black is no less than a ten-thousandth"


@pytest.mark.parametrize(("shape", "cells"), [((240, 320), (40, 30)), ((320, 240), (30, 40)), ((4, 320), (40, 2))])
def test_shading_forty_cells_along_longer_side(shape, cells):
    assert small(np.zeros((*shape, 3), np.uint8)).cells == cells


def test_shading_averages_are_weighted_and_zero_without_usable_pixels():
    weight = np.zeros((240, 320), np.float32)
    weight[:, :4], weight[:, 8:16] = 1, 0.25
    picture = small(np.zeros((240, 320, 3), np.uint8))
    values = np.where(np.arange(320) < 8, 5.0, 7.0).astype(np.float32) * np.ones((240, 1), np.float32)
    values[:, 4:8] = 99
    mean, share = picture.averaged(values, weight)
    assert (mean[:, 0] == 5).all() and (share[:, 0] == 0.5).all()
    assert (mean[:, 1] == 7).all() and (share[:, 1] == 0.25).all()
    assert not mean[:, 2:].any() and not share[:, 2:].any()
    three, _ = picture.averaged(np.stack([values, 2 * values, 3 * values], 2), weight)
    np.testing.assert_allclose(three, mean[..., None] * [1, 2, 3])


def test_shading_steps_between_known_neighbours_only():
    cells = np.array([[1.0, 3.0, 7.0], [2.0, 9.0, 20.0]])
    share = np.array([[1.0, LEAST_KNOWN, 0.9], [1.0, LEAST_KNOWN - 0.01, 1.0]])
    assert sorted(shading._steps(cells, share)) == [1.0, 2.0, 4.0, 13.0]
    both = shading._steps(np.stack([cells, -cells], 2), share)
    assert both.shape == (4, 2) and (both[:, 0] == -both[:, 1]).all()


def test_shading_spread_is_standard_deviation_with_lower_limit():
    steps = np.random.default_rng(0).normal(0, 0.2, 20_000)
    assert shading._spread(steps) == pytest.approx(0.2, rel=0.03)
    assert shading._spread(steps / 100) == shading._spread(steps[:0]) == LEAST_DETAIL


def test_least_pigment_weights_cancel_pigment():
    """Pigment changes the channels by 1, 2 and 3 parts. Weights sum to 1."""
    strength = np.random.default_rng(0).normal(0, 0.3, (500, 1))
    weights = shading._least_pigment(strength * [1, 2, 3])
    assert weights.sum() == pytest.approx(1) and abs(weights @ [1, 2, 3]) < 0.01
    np.testing.assert_allclose(shading._least_pigment(np.zeros((0, 3))), 1 / 3)
    alone = shading._least_pigment(np.random.default_rng(0).normal(0, 1, (5000, 3)) * [0.1, 0.2, 0.4])
    np.testing.assert_allclose(alone, np.array([16, 4, 1]) / 21, atol=0.03)  # inverse variances


@pytest.mark.parametrize(
    ("colour", "is_usable", "is_lit"),
    [
        ((249, 100, 90), True, True), ((250, 100, 90), False, True), ((21, 15, 15), True, True), ((20, 15, 15), False, False),
        ((120, 60, 5), True, True), ((120, 60, 4), False, True),
    ],
)  # fmt: skip
def test_shading_excludes_clipped_and_noisy_pixels(colour, is_usable, is_lit):
    picture = SmallPicture.of(Frame(0, 0, np.full((60, 80, 3), colour, np.uint8)))
    assert (picture.usable == is_usable).all() and (picture.tissue == is_lit).all()


@pytest.mark.parametrize(
    ("size", "reduced"), [((80, 60), (80, 60)), ((640, 400), (320, 200)), ((400, 640), (200, 320))]
)
def test_small_picture_reduces_by_longer_side(size, reduced):
    picture = SmallPicture.of(Frame(0, 0, np.full((size[1], size[0], 3), (150, 70, 60), np.uint8)))
    assert picture.levels.shape == (*reduced[::-1], 3) and picture.usable.shape == picture.tissue.shape == reduced[::-1]


def test_shading_tool_margin_wider_for_shadows_than_highlights():
    mask = np.ones((240, 320), np.uint8)
    mask[:, 160:] = 0
    inside = np.ones((240, 320), np.uint8)
    inside[:20] = 0
    image = np.full((240, 320, 3), (150, 70, 60), np.uint8)
    picture = SmallPicture.of(Frame(0, 0, image, mask=mask, loss_mask=inside))
    assert np.flatnonzero(picture.usable[120]).tolist() == list(range(160 - round(0.07 * 320)))
    assert np.flatnonzero(picture.tissue[120]).tolist() == list(range(160 - round(0.0125 * 320)))
    assert not picture.usable[:20].any() and picture.usable[20:, 10].all()
    assert picture.tissue[:20, 10].all(), "highlights are searched up to the border of the picture"


def test_log_diffuse_requires_red_excess_of_tenth():
    light = lambda colour: np.searchsorted(np.exp(shading._LOG_LIGHT), colour)
    levels = np.array([[light([0.4, 0.35, 0.35]), light([0.4, 0.37, 0.37]), light([0.2, 0.4, 0.4])]], np.uint8)
    diffuse, known = log_diffuse(small(levels))
    assert known.tolist() == [[True, False, False]]
    assert diffuse[0, 0] == pytest.approx(np.log(0.05), abs=0.1)
    assert diffuse[0, 2] == pytest.approx(np.log(1e-4)), "no red at all"
    assert not log_diffuse(small(levels, np.zeros((1, 3))))[1].any()


def change(found: float = 1.0, spread: float = 0.0, share: float = 1.0) -> Change:
    brighter = np.where(np.arange(40) % 2, spread, -spread)[None].repeat(30, 0)
    return Change(brighter, np.full((30, 40), share), np.zeros((30, 40, 2)), found)


@pytest.mark.parametrize(
    ("given", "is_followed"),
    [
        ({}, True), ({"found": 0.6}, True), ({"found": 0.59}, False), ({"spread": 0.149}, True), ({"spread": 0.151}, False),
        ({"share": LEAST_KNOWN}, True), ({"share": LEAST_KNOWN - 0.01}, False),
    ],
)  # fmt: skip
def test_light_change_is_followed_thresholds(given, is_followed):
    assert change(**given).is_followed == is_followed
