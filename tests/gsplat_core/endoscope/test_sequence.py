"""`SequenceCheck`: black, torn, noisy and repeated pictures are reported; ordinary video never is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope import sequence
from gsplat_core.endoscope.sequence import SequenceCheck
from tests.gsplat_core.endoscope.clips import FRAME_NS, PLACES, brightened, clip, texture


def faults(images):
    check = SequenceCheck()
    return [check.fault(image, k * FRAME_NS) for k, image in enumerate(images)]


def with_changed(images, index, change):
    """The pictures, one of them changed: `change` has the picture and the one before it."""
    changed = list(images)
    changed[index] = change(images[index].copy(), images[index - 1])
    return changed


def lower_part_of_the_one_before(share):
    def change(image, before):
        image[round(len(image) * share) :] = before[round(len(image) * share) :]
        return image

    return change


def grey_below(image, before):
    image[len(image) // 2 :] = 128
    return image


def no_signal_screen(image, before):
    image[:] = (0, 0, 190)
    image[10:14, 20:60] = 255
    return image


CHANGES = {
    "black": lambda image, before: image // 25,
    "one colour": no_signal_screen,
    "noise": lambda image, before: np.random.default_rng(0).integers(0, 256, image.shape, np.uint8),
    "duplicate": lambda image, before: before,
    "torn": lower_part_of_the_one_before(0.6),
}


@pytest.mark.parametrize("fault", CHANGES)
def test_sequence_check_reports_single_fault_and_accepts_next_frame(fault):
    images = with_changed(texture(1, 20), 12, CHANGES[fault])
    assert faults(images) == [None] * 12 + [fault] + [None] * 7


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_sequence_check_withholds_no_frame_of_recordings(recordings_dir, name):
    assert set(faults(clip(recordings_dir, name))) == {None}


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize(
    "fault, change",
    [
        *CHANGES.items(),
        ("torn", lower_part_of_the_one_before(0.2)),
        ("torn", lower_part_of_the_one_before(0.85)),
        ("torn", grey_below),
    ],
)
def test_sequence_check_reports_fault_inserted_in_recording(recordings_dir, name, fault, change):
    images = clip(recordings_dir, name)[:24]
    assert faults(with_changed(images, 15, change)) == [None] * 15 + [fault] + [None] * 8


def test_sequence_check_repeated_image_frozen_after_quarter_second():
    images = texture(2, 12)
    found = faults([*images, *[images[-1]] * 20, *texture(2, 20)[12:]])
    assert found[12:32] == ["duplicate"] * 7 + ["frozen"] * 13
    assert found[32:] == [None] * 8


def test_sequence_check_reencoded_repetition_is_frozen():
    images, rng = texture(2, 12), np.random.default_rng(0)
    again = [np.clip(images[-1] + rng.integers(-1, 2, images[-1].shape), 0, 255).astype(np.uint8) for _ in range(12)]
    assert faults([*images, *again])[-1] == "frozen"


def test_sequence_check_doubled_frames_are_duplicates_not_frozen():
    twice = [image for image in texture(3, 20) for _ in range(2)]
    assert faults(twice) == [None, "duplicate"] * 20


def test_sequence_check_still_scene_with_small_motion_not_frozen():
    still = texture(4, 1)[0]
    images = [still.copy() for _ in range(30)]
    for k, image in enumerate(images):
        image[40:48, 3 * k : 3 * k + 8] = 200
    assert set(faults(images)) == {None}


def test_sequence_check_constant_border_and_strip_not_torn():
    images = [image.copy() for image in texture(5, 30)]
    for image in images:
        image[:12], image[-30:] = 0, 90
        image[-20:-10, 20:60] = 220
    assert set(faults(images)) == {None}


def test_sequence_check_dark_image_not_black():
    assert set(faults([brightened(image, 0.3) for image in texture(6, 10)])) == {None}


def test_sequence_check_restarts_after_size_change():
    assert set(faults([*texture(7, 10), *texture(7, 10, 96, 80)])) == {None}


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 70), st.integers(1, 70), st.integers(0, 2**32), st.booleans())
def test_sequence_check_accepts_images_of_any_size(height, width, seed, flat):
    rng = np.random.default_rng(seed)
    images = [np.full((height, width, 3), rng.integers(0, 256), np.uint8)] * 3
    images += [] if flat else [rng.integers(0, 256, (height, width, 3), np.uint8) for _ in range(8)]
    assert len(faults(images + images[::-1])) == 2 * len(images)


@pytest.mark.parametrize(
    ("interval_s", "expected"),
    [(0.2, ["duplicate", "frozen"]), (0.1, ["duplicate"] * 2 + ["frozen"]), (1.0, ["duplicate", "frozen"])],
)
def test_sequence_check_frozen_after_quarter_second_and_two_repetitions(interval_s, expected):
    check, image = SequenceCheck(), texture(1, 1)[0]
    found = [check.fault(image, round(k * interval_s * 1e9)) for k in range(len(expected) + 1)]
    assert found == [None, *expected]


def test_sequence_check_with_stopped_clock_frozen_after_eight_repetitions():
    check, image = SequenceCheck(), texture(1, 1)[0]
    assert [check.fault(image, 0) for _ in range(9)] == [None, *["duplicate"] * 7, "frozen"]


@pytest.mark.parametrize(("period_px", "fault"), [(10, None), (8, None), (5, "noise")])
def test_sequence_check_noise_threshold_of_neighbour_difference(period_px, fault):
    """For a sine this ratio is 1 - cos(2 pi / period)."""
    x = np.tile(128 + 60 * np.sin(2 * np.pi * (np.arange(160) + 0.3) / period_px), (128, 1))
    image = np.repeat(np.rint(x)[..., None], 3, axis=2).astype(np.uint8)
    assert SequenceCheck().fault(image, 0) == fault


def test_sequence_check_fibre_bundle_image_not_noise():
    image = cv2.GaussianBlur(texture(1, 1, 240, 192)[0], (0, 0), 4)
    y, x = np.mgrid[:192, :240]
    fibres = (1 + np.cos(2.1 * x) * np.cos(2.1 * y)) / 2
    assert SequenceCheck().fault((image * fibres[..., None]).astype(np.uint8), 0) is None


def test_sequence_check_lasting_strip_torn_for_few_frames_only():
    images = [image.copy() for image in texture(5, 60)]
    for image in images[20:]:
        image[-20:] = 90
    found = faults(images)
    assert found[:20] == [None] * 20 and found[20] == "torn" and set(found[26:]) == {None}


@pytest.mark.parametrize(("size", "fault"), [((31, 160), None), ((32, 160), "noise")])
def test_sequence_check_skips_noise_test_for_small_images(size, fault):
    image = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    assert SequenceCheck().fault(image, 0) == fault


@pytest.mark.parametrize(("share", "fault"), [(0.05, None), (0.15, "torn"), (0.85, "torn"), (0.97, None)])
def test_sequence_check_tear_minimum_height_on_both_sides(share, fault):
    images = with_changed(texture(1, 20), 12, lower_part_of_the_one_before(1 - share))
    assert faults(images)[12] == fault


@pytest.mark.parametrize(("index", "fault"), [(3, None), (9, "torn")])
def test_sequence_check_finds_tears_after_learning_moving_rows(index, fault):
    assert faults(with_changed(texture(1, 12), index, lower_part_of_the_one_before(0.5)))[index] == fault


def test_sequence_check_grey_lower_part_is_torn():
    assert faults(with_changed(texture(1, 20), 12, grey_below))[12] == "torn"


@pytest.mark.parametrize(("deviation", "fault"), [(3, "torn"), (6, None)])
def test_sequence_check_grey_lower_part_with_coding_errors_is_torn(deviation, fault):
    """A colour may deviate by 3 levels."""

    def change(image, before):
        half = image[len(image) // 2 :]
        half[:] = 128 + np.random.default_rng(0).integers(-deviation, deviation + 1, half.shape)
        return image

    assert faults(with_changed(texture(1, 20), 12, change))[12] == fault


@pytest.mark.parametrize(("lit", "fault"), [(0.02, "black"), (0.05, None)])
def test_sequence_check_black_image_allows_few_lit_pixels(lit, fault, monkeypatch):
    monkeypatch.setattr(sequence, "ONE_COLOUR_LEVELS", 0)
    image = np.zeros((128, 128, 3), np.uint8)
    image[: round(128 * lit)] = np.random.default_rng(0).integers(60, 62, (round(128 * lit), 128, 3))
    found = SequenceCheck().fault(image, 0)
    assert (found == "black") == (fault == "black")


@pytest.mark.parametrize(("spread", "is_one_colour"), [(3, True), (12, False)])
def test_sequence_check_one_colour_requires_small_spread_per_channel(spread, is_one_colour):
    rng = np.random.default_rng(0)
    image = np.full((128, 128, 3), (120, 60, 50), np.uint8)
    for channel in range(3):
        spotted = image.copy()
        spotted[:, ::8, channel] += rng.integers(0, spread + 1, (128, 16), np.uint8)
        spotted[:, ::16, channel] += np.uint8(spread - 3)
        assert (SequenceCheck().fault(spotted, 0) == "one colour") == is_one_colour


def test_sequence_check_rarely_changing_strip_not_torn():
    """Rows are compared only if they changed in nine of ten frames; the strip changes in one of four."""
    images = [image.copy() for image in texture(5, 40)]
    for k, image in enumerate(images):
        image[-40:] = images[4 * (k // 4)][-40:]
    assert set(faults(images)) == {None}


@pytest.mark.parametrize(("coloured", "fault"), [(False, "torn"), (True, None)])
def test_sequence_check_lower_part_varying_in_one_channel_not_torn(coloured, fault):
    def change(image, before):
        image[len(image) // 2 :] = 128
        # The last row has no content, so that the rows above it decide.
        image[len(image) // 2 : -1, ::8, 2] += np.uint8(60 * coloured)
        return image

    assert faults(with_changed(texture(1, 20), 12, change))[12] == fault
