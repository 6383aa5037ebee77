"""Separation of a picture into illumination, pigment and highlights."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.experimental.shading import SmallPicture, log_diffuse, shading_in
from gsplat_core.scene.frames import Frame


def test_shading_counts_glints_at_their_places_only() -> None:
    """Small white dots on red tissue, on one side of the picture."""
    image = np.full((256, 320, 3), (150, 70, 60), np.uint8)
    dots = np.zeros((256, 320), np.uint8)
    for x in range(20, 150, 16):
        for y in range(20, 240, 16):
            cv2.circle(dots, (x, y), 2, 1, -1)
    image[dots > 0] = 255
    found = shading_in(SmallPicture.of(Frame(0, 0, image)))
    left, right = found.glints[:, :19], found.glints[:, 21:]
    assert right.max() == 0
    assert 0.7 < left.sum() * 64 / np.count_nonzero(dots) < 1.3, "cells are 8 pixels wide"
    assert (found.wet_share > 0.9).all()


def recorded(light: np.ndarray) -> np.ndarray:
    """Return the levels of a camera that compresses highlights, and stores sRGB."""
    linear = (1 - np.exp(-0.8 * light)) / 0.8
    return (255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)).round()


@pytest.mark.parametrize(("excess", "share"), [(0.25, 0.0), (0.5, 1.0), (2.0, 1.0)])
def test_shading_glint_requires_white_excess_of_third(excess: float, share: float) -> None:
    """The lamp's reflection adds as much to each channel."""
    tissue = np.array([0.35, 0.08, 0.05])
    image, dots = np.zeros((256, 320, 3), np.uint8), np.zeros((256, 320), np.uint8)
    image[:] = recorded(tissue)
    for x in range(20, 310, 24):
        for y in range(20, 240, 24):
            cv2.circle(dots, (x, y), 2, 1, -1)
    image[dots > 0] = recorded(tissue + excess * tissue[0])
    found = shading_in(SmallPicture.of(Frame(0, 0, image)))
    assert found.glints.sum() * 64 / np.count_nonzero(dots) == pytest.approx(share, abs=0.15)


@pytest.mark.parametrize("dimmer", [2.0, 5.0])
def test_shading_diffuse_brightness_is_logarithm_of_light(dimmer: float) -> None:
    tissue = np.array([0.6, 0.25, 0.2])
    image = np.zeros((256, 320, 3), np.uint8)
    image[:, :160], image[:, 160:] = recorded(tissue), recorded(tissue / dimmer)
    found = shading_in(SmallPicture.of(Frame(0, 0, image))).diffuse
    assert found is not None
    seen = found.brightness[:, :18].mean() - found.brightness[:, 22:].mean()
    assert seen == pytest.approx(np.log(dimmer), abs=0.02)


@pytest.mark.parametrize("tissue", [(0.6, 0.25, 0.2), (0.3, 0.1, 0.05)])
def test_log_diffuse_is_red_excess_independent_of_reflections(tissue: tuple[float, float, float]) -> None:
    """A reflection adds as much to each channel. The unit of light is the recorded one of dim light."""
    light, reflection = np.array(tissue), 0.05
    image = np.zeros((64, 80, 3), np.uint8)
    image[:, :40], image[:, 40:] = recorded(light), recorded(light + reflection)
    found, known = log_diffuse(SmallPicture.of(Frame(0, 0, image)))
    assert known.all()
    np.testing.assert_allclose(found, np.log(light[0] - (light[1] + light[2]) / 2), atol=0.03)
