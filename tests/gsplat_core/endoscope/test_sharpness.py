"""Blur and smoke are found beside what is usual in a stream, and ordinary frames are never withheld."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope.sharpness import SharpnessGate, SharpnessSettings, appearance
from gsplat_core.errors import InvalidSetting
from tests.gsplat_core.endoscope.clips import PLACES, brightened, clip, texture


def faults(images, kept=None, settings=None):
    gate = SharpnessGate(settings)
    return [gate.fault(image, kept) for image in images]


def defocused(image):
    return cv2.GaussianBlur(image, (0, 0), 4 * max(image.shape) / 640)


def moved(image, down=False):
    """As seen by a scope that moves by a fortieth of the picture while the shutter is open."""
    length = round(max(image.shape) / 40) | 1
    return cv2.blur(image, (1, length) if down else (length, 1))


def smoky(image, density=0.45, seed=0):
    """Behind a cloud of pale smoke with thicker and thinner places."""
    coarse = np.random.default_rng(seed).random((5, 6)).astype(np.float32)
    cloud = cv2.resize(coarse, image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    share = np.clip(density * (0.6 + 0.8 * cloud), 0, 1)[..., None]
    return np.clip(image * (1 - share) + 205 * share, 0, 255).astype(np.uint8)


FAULTS = {
    "defocus": (defocused, {"blur"}),
    "motion across": (moved, {"blur"}),
    "motion down": (lambda image: moved(image, down=True), {"blur"}),
    # Dense smoke softens a picture, too.
    "smoke": (smoky, {"smoke", "blur"}),
}


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_no_frame_of_a_recording_is_withheld(recordings_dir, name):
    assert set(faults(clip(recordings_dir, name))) == {None}


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("fault", FAULTS)
def test_every_bad_frame_in_a_recording_is_found_and_the_next_good_one_is_good(recordings_dir, name, fault):
    spoil, reasons = FAULTS[fault]
    images = clip(recordings_dir, name)[:30]
    found = faults([*images[:15], *map(spoil, images[15:22]), *images[22:]])
    assert found[:15] + found[22:] == [None] * 23
    assert set(found[15:22]) <= reasons


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["cutting", "heart", "colon"])
def test_smoke_is_called_smoke(recordings_dir, name):
    images = clip(recordings_dir, name)[:20]
    assert faults([*images[:15], *map(smoky, images[15:])])[15:] == ["smoke"] * 5


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_exposure_white_balance_and_a_tool_are_neither(recordings_dir, name):
    images = list(clip(recordings_dir, name)[:30])
    half = images[20].copy()
    half[:, : half.shape[1] // 2] = (126, 129, 133)
    others = [brightened(images[20], gain) for gain in (1.5, 0.6, (1.2, 1.0, 0.8))]
    assert set(faults([*images[:20], half, *others])) == {None}


def test_smoke_that_gathers_slowly_is_found():
    images = texture(1, 90, 320, 256)
    found = faults([smoky(image, 0.6 * max(0, k - 30) / 60) for k, image in enumerate(images)])
    assert found[:30] == [None] * 30 and set(found[70:]) == {"smoke"}


def test_between_the_limits_a_frame_stays_what_the_one_before_was():
    sharp = texture(2, 40, 320, 256)
    usual = appearance(sharp[0]).rows
    soft = []
    for image in sharp:
        widths = np.linspace(0.3, 3, 40)
        blurred = [cv2.GaussianBlur(image, (0, 0), width) for width in widths]
        soft.append(min(blurred, key=lambda each: abs(appearance(each).rows / usual - 0.785)))
    assert set(faults([*sharp[:10], *soft[10:20]])) == {None}
    assert faults([*sharp[:10], defocused(sharp[10]), *soft[11:20], sharp[20]])[10:] == ["blur"] * 10 + [None]


def test_a_stream_that_stays_soft_is_not_withheld_for_ever():
    images = texture(3, 60, 320, 256)
    found = faults([*images[:10], *map(defocused, images[10:])], settings=SharpnessSettings(longest_frames=20))
    assert found[10:30] == ["blur"] * 20 and set(found[31:]) == {None}


def test_what_is_left_out_does_not_count():
    images = [image.copy() for image in texture(4, 20, 320, 256)]
    kept = np.ones(images[0].shape[:2], np.uint8)
    kept[:, :276] = 0
    for image in images[10:]:
        image[:, :270] = defocused(image)[:, :270]
    assert set(faults(images)[10:]) == {"blur"}
    assert set(faults(images, kept)) == {None}


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 2**32))
def test_no_picture_of_any_size_raises(height, width, seed):
    rng = np.random.default_rng(seed)
    gate = SharpnessGate(SharpnessSettings(first_frames=1, longest_frames=2))
    for _ in range(6):
        image = rng.integers(0, rng.integers(1, 257), (height, width, 3), np.uint8)
        gate.fault(image, rng.integers(0, 2, (height, width), np.uint8) if rng.random() < 0.5 else None)


def test_settings_out_of_range_are_refused():
    with pytest.raises(InvalidSetting, match="blurred_below"):
        SharpnessSettings(blurred_below=0.0)
