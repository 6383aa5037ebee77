"""Changes of gain and white balance are recovered; video without them keeps gains of exactly 1."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope import exposure
from gsplat_core.endoscope.exposure import UNCHANGED, ExposureEstimator
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def estimator_of(monkeypatch, found, same=(10.0, 10.0), **fields):
    """An estimator to which every frame compares as `found` says, with shares of pixels that agree with a change and with none."""
    made = ExposureEstimator()
    monkeypatch.setattr(made, "_compare", lambda sample, references: found)
    shares = iter(same)
    monkeypatch.setattr(exposure, "share_with", lambda *given: next(shares))
    made._previous = made._anchor = SimpleNamespace(sample=None, log_gain=np.zeros(3))
    for name, value in fields.items():
        setattr(made, name, value)
    return made


@pytest.mark.parametrize(
    ("change", "spread", "same", "is_change"),
    [
        (0.08, 0.0, (10, 15), False), (0.081, 0.0, (10, 15), True), (0.081, 0.0, (10, 14.9), False),
        (-0.081, 0.0, (10, 15), True), (0.15, 0.1, (1, 9), False), (0.16, 0.1, (1, 9), True),
    ],
)  # fmt: skip
def test_limits_of_a_jump(monkeypatch, change, spread, same, is_change):
    """8 %, one and a half times as much as the frames are unlike, and one and a half times as many pixels that agree."""
    best = SimpleNamespace(sample=None, log_gain=np.zeros(3))
    made = estimator_of(monkeypatch, (np.array([0, change, 0]), spread, best), same)
    assert made._changed(None, [best], 0.08, 1.5) == is_change
    assert made._log_gain.tolist() == [0, change if is_change else 0, 0]


@pytest.mark.parametrize(("step", "is_held"), [(0.0199, True), (0.0201, False)])
def test_a_gain_is_held_again_after_six_steady_frames(monkeypatch, step, is_held):
    made = estimator_of(monkeypatch, None, following=True)
    at = [0.3]

    def compare(sample, references):
        at[0] += step
        return np.full(3, at[0]), 0.0, None

    monkeypatch.setattr(made, "_compare", compare)
    made._log_gain = np.full(3, 0.3)
    settled = []
    monkeypatch.setattr(made, "_settle", lambda sample: settled.append(made._steady))
    for _ in range(5):
        made._follow(None)
        assert made.following
    made._follow(None)
    assert made.following != is_held and settled == ([6] if is_held else [])


@pytest.mark.parametrize(
    ("gain", "anchor", "settled"), [(0.3, 0.1, 0.25), (0.3, 0.2, 0.3), (-0.3, -0.1, -0.25), (0.0399, 0.0, 0.0), (0.0401, 0, 0.0401)]
)  # fmt: skip
def test_a_settled_gain_is_near_that_of_the_first_frame_and_none_below_4_percent(monkeypatch, gain, anchor, settled):
    made = estimator_of(monkeypatch, (np.full(3, anchor), 0.0, None))
    made._log_gain = np.full(3, gain)
    made._settle(None)
    np.testing.assert_allclose(made._log_gain, settled)


@pytest.mark.parametrize(("passed_s", "counted_s"), [(0.5, 0.5), (1.0, 1.0), (60.0, 1.0), (-3.0, 0.0)])
def test_a_held_gain_is_forgotten_by_five_minutes_and_a_gap_counts_a_second(passed_s, counted_s):
    made = ExposureEstimator()
    made._log_gain, made._last_pts_ns = np.full(3, 0.5), 0
    made._forget(round(passed_s * 1e9))
    np.testing.assert_allclose(made._log_gain, 0.5 * np.exp(-counted_s / 300))


def test_gains_stay_within_eight_and_its_inverse():
    made = ExposureEstimator()
    made._set(np.array([9.0, -9.0, 1.0]))
    assert made.gains == pytest.approx((8, 1 / 8, np.e))


def test_references_are_weighed_by_how_alike_they_are(monkeypatch):
    """Spreads 0.04 and 0.09 weigh 400 to 100; what is beyond 0.25 says nothing, and only the three best count."""
    shifts = {"a": (0.2, 0.04), "b": (0.1, 0.09), "c": (5.0, 0.251), "d": (0.1, 0.09), "e": (9.0, 0.2)}
    monkeypatch.setattr(exposure, "ratio", lambda sample, name, channel: shifts[name] if channel != 2 else (0, 0.3))
    references = [SimpleNamespace(sample=name, log_gain=np.zeros(3)) for name in "cebda"]
    measured, spread, best = ExposureEstimator()._compare(None, references)
    expected = (400 * 0.2 + 2 * 100 * 0.1) / 600
    np.testing.assert_allclose(measured, expected)  # blue, of which nothing is known, as the others
    assert (spread, best.sample) == (0.04, "a")
    assert ExposureEstimator()._compare(None, references[:1]) is None
    shifts["c"] = (0.7, 0.25)
    assert ExposureEstimator()._compare(None, references[:1])[0] == pytest.approx(0.7)
