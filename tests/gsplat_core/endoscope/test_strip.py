"""`StripDetector`: static strips and text at the borders are found; tissue is not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope import artefacts
from gsplat_core.endoscope.artefacts import StripDetector
from tests.gsplat_core.endoscope.clips import PLACES, clip, texture

HEIGHT, WIDTH = 256, 320
FRAMES = 2 * 10 * 4 + 4


def last_mask(images):
    detector = StripDetector()
    for image in images:
        detector.observe(image)
    return detector.mask


def drawn_into(images, draw):
    changed = [image.copy() for image in images]
    for image in changed:
        draw(image)
    return changed


def strip_below(image):
    image[-14:] = (25, 28, 70)
    cv2.putText(image, "REC 00:12", (20, HEIGHT - 3), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1)


def half_a_strip_below(image):
    image[-10:, :150] = (15, 15, 15)


def bar_at_the_right(image):
    image[:, -12:] = (0, 0, 0)


def text_above(image):
    cv2.putText(image, "ID 4711", (8, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)


DRAWN = {
    "strip": (strip_below, np.s_[-14:]),
    "half a strip": (half_a_strip_below, np.s_[-10:, :150]),
    "bar": (bar_at_the_right, np.s_[:, -12:]),
    "text": (text_above, np.s_[5:14, 8:60]),
}


@pytest.mark.parametrize("what", DRAWN)
def test_strip_detector_masks_overlays_and_little_else(what):
    draw, place = DRAWN[what]
    mask = last_mask(drawn_into(texture(1, FRAMES, WIDTH, HEIGHT), draw))
    there = np.zeros((HEIGHT, WIDTH), bool)
    there[place] = True
    around = cv2.dilate(there.astype(np.uint8), np.ones((13, 13), np.uint8)).astype(bool)
    assert (mask[there] == 0).mean() > 0.8
    assert (mask[~around] == 0).mean() < 0.002


def test_strip_detector_finds_none_on_tissue():
    assert last_mask(texture(2, FRAMES, WIDTH, HEIGHT)) is None


@pytest.mark.slow
def test_strip_detector_drops_vanished_strip():
    images = texture(3, 2 * FRAMES, WIDTH, HEIGHT)
    detector = StripDetector()
    for image in drawn_into(images[:FRAMES], strip_below):
        detector.observe(image)
    assert detector.mask is not None
    for image in [*images[FRAMES:], *images, *images]:
        detector.observe(image)
    assert detector.mask is None


@pytest.mark.recordings
def test_strip_detector_finds_panels_below_cutting(recordings_dir):
    mask = last_mask(clip(recordings_dir, "cutting"))
    assert (mask[506:, 5:330] == 0).mean() > 0.9
    assert (mask[:495] == 0).mean() < 0.002


@pytest.mark.recordings
@pytest.mark.parametrize("name", [name for name in PLACES if name != "sinus"])
def test_strip_detector_masks_little_of_recordings(recordings_dir, name):
    mask = last_mask(clip(recordings_dir, name) * 2)
    assert mask is None or (mask == 0).mean() < 0.015


@pytest.mark.recordings
def test_strip_detector_finds_strip_and_text_over_beating_heart(recordings_dir):
    images = [cv2.resize(image, (WIDTH, HEIGHT)) for image in clip(recordings_dir, "heart")[:FRAMES]]
    mask = last_mask(drawn_into(images, lambda image: (strip_below(image), text_above(image))))
    assert (mask[-14:] == 0).mean() > 0.7 and (mask[5:14, 8:60] == 0).mean() > 0.7
    assert (mask[30:-30, 30:-30] == 0).sum() == 0


@settings(deadline=None, max_examples=20)
@given(st.integers(1, 90), st.integers(1, 90), st.integers(0, 2**32))
def test_strip_detector_accepts_images_of_any_size(height, width, seed):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(artefacts, "EXAMINE_EVERY", 1)
        patch.setattr(artefacts, "DECIDE_EVERY", 2)
        detector = StripDetector()
        for _ in range(8):
            mask = detector.observe(image if rng.random() < 0.8 else image[:, ::-1])
            assert mask is None or mask.shape == (height, width)
