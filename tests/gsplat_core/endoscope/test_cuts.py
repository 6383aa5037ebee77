"""`CutDetector`: a new scene is detected with its second frame; events within a scene are not reported as cuts."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope import changes
from gsplat_core.endoscope.changes import CutDetector, FrameRate, View
from tests.gsplat_core.endoscope.clips import FRAME_NS, PLACES, brightened, clip, resized, texture

OTHERS = list(itertools.permutations(PLACES, 2))


def verdicts(images, withheld=()):
    """Return the reported events by frame index."""
    detector, found = CutDetector(), {}
    for k, image in enumerate(images):
        if k in withheld:
            detector.skip()
            continue
        verdict = detector.observe(image, k, k * FRAME_NS)
        if verdict.new_scene or verdict.in_doubt:
            found[k] = verdict.new_scene or "in doubt"
    return found


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("every", [1, 4, 8])
@pytest.mark.slow
def test_cut_detector_reports_no_cut_in_recordings_with_omitted_frames(recordings_dir, name, every):
    assert verdicts(clip(recordings_dir, name)[::every]) == {}


def tool_sweeps_in(images):
    swept = []
    for k, image in enumerate(images):
        image, columns = image.copy(), int(image.shape[1] * 0.75 * np.clip((k - 8) / 6, 0, 1))
        image[:, :columns] = (122, 126, 131)
        swept.append(image)
    return swept


def view_jumps(images):
    height, width = images[0].shape[:2]
    shift = np.array([[1, 0, 0.25 * width], [0, 1, -0.15 * height]], np.float32)
    moved = [cv2.warpAffine(image, shift, (width, height), borderMode=cv2.BORDER_REFLECT) for image in images[10:]]
    return [*images[:10], *moved]


EVENTS = {
    "the exposure and the white balance jump": lambda images: [
        *images[:10],
        *(brightened(image, (1.7, 1.3, 2.0)) for image in images[10:]),
    ],
    "it becomes dark": lambda images: [*images[:10], *(brightened(image, 0.35) for image in images[10:])],
    "a tool covers three quarters within six frames": tool_sweeps_in,
    "the view jumps by a quarter of the picture": view_jumps,
    "it is out of focus": lambda images: [*images[:10], *(cv2.GaussianBlur(image, (0, 0), 8) for image in images[10:])],
    "the recording begins again": lambda images: [*images, *images],
}


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("event", EVENTS)
def test_cut_detector_ignores_events_within_scene(recordings_dir, name, event):
    assert verdicts(EVENTS[event](clip(recordings_dir, name)[:24])) == {}


@pytest.mark.recordings
@pytest.mark.parametrize("first, second", OTHERS)
def test_cut_detector_reports_splice_and_return_as_cuts(recordings_dir, first, second):
    before = list(clip(recordings_dir, first)[:20])
    between = resized(clip(recordings_dir, second)[5:20], before[0])
    found = verdicts([*before, *between, *before[10:]])
    assert found == {20: "in doubt", 21: "cut", 35: "in doubt", 36: "cut"}


@pytest.mark.recordings
@pytest.mark.parametrize("first, second", OTHERS)
def test_cut_detector_after_withheld_frames_reports_only_different_scene(recordings_dir, first, second):
    before = list(clip(recordings_dir, first))
    other = resized(clip(recordings_dir, second)[5:20], before[0])
    assert verdicts([*before[:20], *other], range(15, 24)) == {24: "in doubt", 25: "cut"}
    assert verdicts(before[:35], range(8, 24)) == {}


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_cut_detector_marks_single_noise_frame_in_doubt_only(recordings_dir, name):
    images, noise = list(clip(recordings_dir, name)[:20]), np.random.default_rng(0)
    images[10] = noise.integers(0, 256, images[10].shape, np.uint8)
    assert verdicts(images) == {10: "in doubt"}


def test_cut_detector_reports_cut_after_six_unrelated_frames():
    rng = np.random.default_rng(0)
    unrelated = [rng.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(7)]
    assert list(verdicts([*texture(1, 5, 64, 48), *unrelated]).values()) == ["in doubt"] * 6 + ["cut"]


def test_cut_detector_accepts_frame_similar_to_kept_view():
    present, elsewhere = texture(1, 40, 64, 48), texture(2, 1, 64, 48)
    assert verdicts([*present, *elsewhere, present[14]]) == {40: "in doubt"}
    detector = CutDetector()
    for k, image in enumerate(present):
        detector.observe(image, k, k * FRAME_NS)
    detector._last = View(elsewhere[0])  # as if the picture had changed completely, but gradually
    verdict = detector.observe(present[14], 40, 40 * FRAME_NS)
    assert (verdict.new_scene, verdict.in_doubt) == (None, False)


def test_cut_detector_compares_confirming_frame_with_two_frames_only(monkeypatch):
    """The confirming frame is displayed, and a comparison with all kept views would delay its picture."""
    detector = CutDetector()
    for k, image in enumerate([*texture(1, 80, 64, 48), texture(2, 2, 64, 48)[0]]):
        detector.observe(image, k, k * FRAME_NS)
    compared = []
    same = detector._same
    monkeypatch.setattr(detector, "_same", lambda view, other, gap: compared.append(other) or same(view, other, gap))
    assert detector.observe(texture(2, 2, 64, 48)[1], 81, 81 * FRAME_NS).new_scene == "cut"
    assert len(compared) == 2


def test_cut_detector_eventually_accepts_stream_of_unrelated_frames(rng):
    pictures = [rng.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(30)]
    detector = CutDetector()
    doubts = [detector.observe(picture, k, k * FRAME_NS).in_doubt for k, picture in enumerate(pictures)]
    assert doubts == [False, *[True] * 6, False, *[True] * 3, False, True, *[False] * 17]


def test_cut_detector_at_low_frame_rate_is_in_doubt_for_quarter_second(rng):
    pictures = [rng.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(4)]
    detector = CutDetector()
    doubts = [detector.observe(picture, k, k * 200_000_000).in_doubt for k, picture in enumerate(pictures)]
    assert doubts == [False, True, True, False]


def test_cut_detector_starts_new_scene_at_size_change():
    assert verdicts([*texture(1, 5), *texture(1, 5, 120, 90)]) == {5: "resized"}


def test_frame_rate_detects_rate_change_but_not_lost_frames():
    rate = FrameRate()
    every = [rate.changed(k, k * 40) for k in range(60)]
    lossy = [rate.changed(60 + 3 * k, 2400 + 120 * k) for k in range(40)]
    assert not any(every) and not any(lossy)
    later = [rate.changed(200 + k, 9000 + 20 * k) for k in range(60)]
    assert sum(later) == 1


def test_frame_rate_ignores_clock_jitter():
    rate, rng, now = FrameRate(), np.random.default_rng(0), 0
    found = []
    for k in range(500):
        now += int(rng.choice([10, 40, 40, 80]))
        found.append(rate.changed(k, now))
    assert not any(found)


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32))
def test_cut_detector_accepts_images_of_any_size(height, width, seed):
    rng = np.random.default_rng(seed)
    shapes = [(height, width, 3), (width, height, 3)]
    images = [rng.integers(0, rng.integers(1, 257), shapes[k // 4], np.uint8) for k in range(8)]
    detector = CutDetector()
    for k, image in enumerate(images):
        detector.observe(image, int(rng.integers(0, 9)), int(rng.integers(-9, 9)))
        if k % 3 == 0:
            detector.skip()


@pytest.mark.parametrize(
    ("usual", "now", "is_other"), [(10, 14, False), (10, 15, True), (14, 10, False), (14, 9, True), (10, 10, False)]
)
def test_frame_rate_changes_beyond_factor_1_4(usual, now, is_other, monkeypatch):
    monkeypatch.setattr(changes, "RATE_FRAMES", 3)
    rate, seq, at = FrameRate(), 0, 0
    said = [rate.changed(seq, at)]
    for interval in [usual] * 3 + [now] * 3:
        seq, at = seq + 1, at + interval
        said.append(rate.changed(seq, at))
    assert said == [False] * 6 + [is_other]


def likeness_of(monkeypatch, difference, structure=0.0, moved=0.0, colours=0.0):
    for name, value in {"difference": difference, "structure": structure, "moved": moved, "colours": colours}.items():
        monkeypatch.setattr(changes, name, lambda *_, value=value: value)


@pytest.mark.parametrize(
    ("found", "gap", "same"),
    [
        ({"difference": 0.15}, False, True), ({"difference": 0.151}, False, False),
        ({"difference": 1, "structure": 0.72}, False, True), ({"difference": 1, "structure": 0.719}, False, False),
        ({"difference": 1, "moved": 0.83}, False, True), ({"difference": 1, "moved": 0.829}, False, False),
        ({"difference": 0.2, "colours": 0.65}, True, True), ({"difference": 0.2, "colours": 0.65}, False, False),
        ({"difference": 0.201, "colours": 0.65}, True, False), ({"difference": 0.2, "colours": 0.649}, True, False),
    ],
)  # fmt: skip
def test_cut_detector_same_scene_thresholds(monkeypatch, found, gap, same):
    likeness_of(monkeypatch, **found)
    assert CutDetector()._same(None, None, gap) == same


def test_cut_detector_doubts_six_unmatched_frames_and_cuts_at_seventh(monkeypatch):
    likeness_of(monkeypatch, 1.0)
    detector, image = CutDetector(), np.zeros((32, 40, 3), np.uint8)
    said = [detector.observe(image, k, k * FRAME_NS) for k in range(9)]
    assert [each.in_doubt for each in said] == [False, *[True] * 6, False, True]
    assert said[7].new_scene == "cut"


def test_cut_detector_keeps_every_fifteenth_frame_up_to_four_views(monkeypatch):
    likeness_of(monkeypatch, 0.0)
    detector, image = CutDetector(), np.zeros((32, 40, 3), np.uint8)
    counts = []
    for k in range(90):
        detector.observe(image, k, k * FRAME_NS)
        counts.append(len(detector._views))
    assert [counts[k] for k in (13, 14, 28, 29, 59, 89)] == [0, 1, 1, 2, 4, 4]
    assert (detector._views.maxlen, detector._rate._recent.maxlen) == (4, 15)


def test_colours_returns_share_of_pixels_with_equal_hue():
    """Half of each picture is red, the other half green or blue."""
    red, green, blue = (220, 60, 60), (60, 220, 60), (60, 60, 220)

    def view(left, right):
        image = np.zeros((96, 128, 3), np.uint8)
        image[:, :64], image[:, 64:] = left, right
        return changes.View(image)

    assert changes.colours(view(red, green), view(red, green)) == pytest.approx(1)
    assert changes.colours(view(red, green), view(green, red)) == pytest.approx(1)
    assert changes.colours(view(red, green), view(red, blue)) == pytest.approx(0.5)


def test_structure_matches_blocks_shifted_by_up_to_eight_pixels():
    """Blocks of a shifted picture are matched, blocks of other tissue are not, and a flat picture has no structure."""
    image = texture(1, 1, 200, 160)[0]
    one, shifted = image[:128, :160], image[4:132, 6:166]
    other = texture(2, 1)[0]
    found = [changes.structure(changes.View(one), changes.View(picture)) for picture in (one, shifted, other)]
    assert found[0] == pytest.approx(1, abs=1e-4)
    assert found[1] > 0.9 > 0.6 > found[2] > 0
    assert changes.structure(changes.View(np.full_like(one, 120)), changes.View(one)) == 0


def test_moved_finds_quarter_of_image_after_large_motion():
    image = texture(1, 1, 260, 208)[0]
    one, moved = changes.View(image[:128, :160]), changes.View(image[60:188, 76:236])
    assert changes.moved(one, moved) == changes.moved(moved, one) > 0.8
    assert changes.moved(one, changes.View(texture(2, 1)[0])) < 0.6
