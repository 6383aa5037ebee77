"""Matching of the right eye's colours to those of the left one."""

from itertools import pairwise

import numpy as np
import pytest

from gsplat_core.scene.frames import Frame
from gsplat_core.training.observations import COMPARE_EVERY, NOISE_LEVELS, EyeColours, best_shift, line_between
from tests.gsplat_core.training.two_eyes import LEFT, RIGHT, seen, stereo_frame

GAIN, OFFSET = np.array([0.8, 1.1, 1.25]), np.array([12.0, -6.0, 4.0])


def other_colours(image):
    """The colours of an eye whose line back to the other one's is GAIN and OFFSET."""
    return np.rint(((image.astype(float) - OFFSET) / GAIN).clip(0, 255)).astype(np.uint8)


def test_eye_colours_removes_linear_colour_difference():
    right = seen(RIGHT)[0]
    found = EyeColours().corrected(stereo_frame(right_image=other_colours(right)))
    assert np.abs(found.astype(float) - right).mean() < 0.2 * np.abs(other_colours(right).astype(float) - right).mean()


def test_eye_colours_keeps_equal_eyes_unchanged():
    frame = stereo_frame()
    assert EyeColours().corrected(frame) is frame.right_image


def test_eye_colours_is_robust_to_highlights_in_one_eye():
    right = seen(RIGHT)[0]
    shining = other_colours(right)
    shining[10:16, 20:28] = 255
    found = EyeColours().corrected(stereo_frame(right_image=shining))
    calm = np.ones(right.shape[:2], bool)
    calm[8:18, 18:30] = False
    assert np.abs(found.astype(float) - right)[calm].mean() < 6


@pytest.mark.parametrize("level", [0, 128, 255])
def test_eye_colours_of_flat_picture_only_shifts(level):
    flat = np.full((40, 60, 3), level, np.uint8)
    shifted = np.full((40, 60, 3), min(255, level + 20), np.uint8)
    found = EyeColours().corrected(Frame(0, 0, flat, right_image=shifted))
    assert np.abs(found.astype(int) - level).max() <= NOISE_LEVELS


def test_eye_colours_line_follows_change_slowly():
    colours = EyeColours()
    right = seen(RIGHT)[0]
    colours.corrected(stereo_frame())
    changed = stereo_frame(right_image=other_colours(right))
    errors = [np.abs(colours.corrected(changed).astype(float) - right).mean() for _ in range(12 * COMPARE_EVERY)]
    assert errors[0] == errors[COMPARE_EVERY - 2], "between two looks nothing moves"
    assert errors[COMPARE_EVERY] < errors[0] and errors[-1] < 0.4 * errors[0]
    assert max(before - after for before, after in pairwise(errors)) < 0.35 * errors[0]


def test_best_shift_is_independent_of_colours():
    random = np.random.default_rng(0)
    wide = random.uniform(0, 255, (20, 60)).astype(np.float32)
    for shift in (-9, 0, 14):
        left, right = wide[:, 10:50], wide[:, 10 + shift : 50 + shift] if shift <= 10 else wide[:, 10:50]
        if shift > 10:
            left, right = wide[:, :40], wide[:, shift : 40 + shift]
        assert best_shift(left, 0.5 * right + 30) == shift


def test_eye_colours_ignores_tools():
    right = seen(RIGHT)[0]
    left = seen(LEFT)[0].copy()
    mask = np.ones(left.shape[:2], np.uint8)
    mask[:, 20:40], left[:, 20:40] = 0, 250
    with_tool = EyeColours().corrected(Frame(0, 0, left, right_image=right, mask=mask))
    assert np.abs(with_tool.astype(float) - right).mean() < 4


def test_line_between_gain_is_unbiased_by_noise():
    random = np.random.default_rng(1)
    truth = random.uniform(60, 180, (4000, 3)).astype(np.float32)
    left, right = (truth + random.normal(0, 12, truth.shape).astype(np.float32) for _ in range(2))
    gain, offset, _ = line_between(left, right)
    assert np.abs(gain - 1).max() < 0.04 and np.abs(offset).max() < 5


def test_eye_colours_of_tiny_picture():
    tiny = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    assert np.array_equal(EyeColours().corrected(Frame(0, 0, tiny, right_image=tiny)), tiny)
