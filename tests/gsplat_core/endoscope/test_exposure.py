"""Changes of gain and white balance are recovered; video without them keeps gains of exactly 1."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope.exposure import UNCHANGED, ExposureEstimator, ExposureSettings
from gsplat_core.errors import InvalidSetting
from tests.gsplat_core.endoscope.clips import FRAME_NS, brightened, clip, texture

STILL = ["cutting", "heart"]
"""Recordings whose camera does not change its exposure."""


def gains_of(images, kept=None):
    estimator = ExposureEstimator()
    return np.array([estimator.observe(image, kept, k * FRAME_NS) for k, image in enumerate(images)])


def step(k, count):
    return np.where(k >= count // 3, 1.4, 1.0) * np.where(k >= 2 * count // 3, 0.55, 1.0)


def ramp(k, count):
    return np.exp(np.interp(k, [count / 4, 3 * count / 4], [0, -0.6]))


def flicker(k, count):
    return 1 + 0.15 * np.sin(1.3 * k)


def white_balance(k, count):
    changed = (k >= count // 2).astype(float)
    return np.exp(changed[:, None] * np.array([0.2, 0.0, -0.25]))


CHANGES = [step, ramp, flicker, white_balance]


def injected(images, change):
    gains = change(np.arange(len(images)), len(images))
    gains = gains if gains.ndim == 2 else np.repeat(gains[:, None], 3, axis=1)
    return [brightened(image, gain) for image, gain in zip(images, gains, strict=True)], gains


def error(found, true):
    """The largest error of the three channels in each frame, as a logarithm."""
    return np.abs(np.log(found / true)).max(axis=1)


@pytest.mark.recordings
@pytest.mark.parametrize("name", STILL)
def test_without_a_change_the_gains_are_exactly_one(recordings_dir, name):
    estimator = ExposureEstimator()
    images = clip(recordings_dir, name)
    assert {estimator.observe(image, None, k * FRAME_NS) for k, image in enumerate(images)} == {UNCHANGED}


@pytest.mark.recordings
@pytest.mark.parametrize("change", CHANGES)
def test_changes_in_cutting_are_recovered(recordings_dir, change):
    images, true = injected(clip(recordings_dir, "cutting"), change)
    off = error(gains_of(images), true)
    # A slow change shows once it is larger than what the tissue does by itself.
    assert np.median(off) < 0.04 and np.percentile(off, 90) < 0.08 and off.max() < 0.13


@pytest.mark.recordings
@pytest.mark.parametrize("change", [step, white_balance])
def test_jumps_above_a_beating_heart_are_recovered(recordings_dir, change):
    images, true = injected(clip(recordings_dir, "heart"), change)
    assert error(gains_of(images), true).max() < 0.05


@pytest.mark.recordings
def test_flicker_above_a_beating_heart_is_recovered_from_frame_to_frame(recordings_dir):
    images, true = injected(clip(recordings_dir, "heart"), flicker)
    found = gains_of(images)
    steps = np.abs(np.diff(np.log(found / true), axis=0)).max(axis=1)
    assert np.percentile(steps, 90) < 0.03


@pytest.mark.recordings
def test_a_jump_while_the_scope_moves_is_recovered(recordings_dir):
    images, true = injected(clip(recordings_dir, "sinus"), step)
    assert error(gains_of(images), true).max() < 0.06


@pytest.mark.parametrize("gain", [0.4, 0.8, 1.25, 2.0])
def test_a_jump_is_recovered_at_once_and_its_end_is_exactly_one_again(gain):
    images = texture(1, 90)
    found = gains_of([brightened(image, gain if 20 <= k < 50 else 1) for k, image in enumerate(images)])
    assert (found[:20] == 1).all()
    assert np.abs(np.log(found[20:50] / gain)).max() < 0.02
    assert (found[-25:] == 1).all()


def test_a_tool_that_comes_in_changes_nothing():
    images = [image.copy() for image in texture(2, 60)]
    for k, image in enumerate(images):
        image[:, : int(np.clip(k - 20, 0, 25) * 2.5)] = (190, 195, 200)
    assert (gains_of(images) == 1).all()


@pytest.mark.recordings
@pytest.mark.parametrize("name", STILL)
@pytest.mark.parametrize("share", [0.3, 0.5])
@pytest.mark.parametrize("colour", [(150, 155, 160), (30, 30, 32), (225, 228, 230)])
def test_a_tool_that_comes_in_fast_without_a_mask_changes_nothing(recordings_dir, name, share, colour):
    images = [image.copy() for image in clip(recordings_dir, name)[:50]]
    for k, image in enumerate(images):
        image[:, : int(image.shape[1] * share * np.clip((k - 12) / 4, 0, 1))] = colour
    assert (gains_of(images) == 1).all()


def test_what_is_left_out_is_not_looked_at():
    kept = np.ones(texture(3, 1)[0].shape[:2], np.uint8)
    kept[:, :120] = 0
    images = [image.copy() for image in texture(3, 40)]
    for image in images[20:]:
        image[:, :120] //= 3
    assert (gains_of(images, kept) == 1).all()
    assert not (gains_of(images) == 1).all()


def test_another_scene_has_its_own_colours():
    estimator = ExposureEstimator()
    for k, image in enumerate(texture(4, 20)):
        estimator.observe(brightened(image, 1.5 if k >= 10 else 1), None, k * FRAME_NS)
    assert min(estimator.gains) > 1.4
    estimator.start_scene()
    assert {estimator.observe(image // 2, None, k * FRAME_NS) for k, image in enumerate(texture(5, 20))} == {UNCHANGED}


def test_hours_of_changes_do_not_add_up_to_a_drift():
    estimator, images, rng = ExposureEstimator(), texture(6, 64), np.random.default_rng(0)
    gain, worst = 1.0, 0.0
    for k in range(1500):
        if k % 20 == 0:
            gain = float(np.exp(rng.uniform(-0.5, 0.4)))
        found = estimator.observe(brightened(images[k % 64], gain), None, k * FRAME_NS)
        worst = max(worst, float(np.abs(np.log(np.array(found) / gain)).max()))
    # The anchor's zone, and what is too small to be followed.
    assert worst < 0.15 + 0.08


def test_a_channel_that_is_dark_changes_as_the_others_do():
    images = [image * np.array([1, 1, 0], np.uint8) for image in texture(7, 30)]
    found = gains_of([brightened(image, 1.3 if k >= 15 else 1) for k, image in enumerate(images)])
    assert np.abs(np.log(found[15:] / 1.3)).max() < 0.03


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32))
def test_no_picture_of_any_size_raises_or_gives_a_wild_gain(height, width, seed):
    rng = np.random.default_rng(seed)
    estimator = ExposureEstimator()
    for _ in range(12):
        image = rng.integers(0, rng.integers(1, 257), (height, width, 3), np.uint8)
        kept = rng.integers(0, 2, (height, width), np.uint8) if rng.random() < 0.5 else None
        gains = estimator.observe(image, kept, int(rng.integers(-(2**60), 2**60)))
        assert all(1 / 8.001 < gain < 8.001 for gain in gains)


def test_settings_out_of_range_are_refused():
    with pytest.raises(InvalidSetting, match="dead_zone"):
        ExposureSettings(dead_zone=0.0)
