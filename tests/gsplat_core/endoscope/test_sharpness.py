"""`SharpnessGate`: sudden blur and smoke are reported; usual appearance is accepted, and no interval without frames lasts seconds."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope import changes
from gsplat_core.endoscope.changes import Appearance, SharpnessGate, appearance
from gsplat_core.io.recordings import open_recording
from tests.gsplat_core.endoscope.clips import PLACES, brightened, clip, texture


def faults(images, kept=None, fps=30.0):
    gate = SharpnessGate()
    return [gate.fault(image, round(k * 1e9 / fps), kept) for k, image in enumerate(images)]


def longest(found, fps=30.0):
    """Return the longest interval between two accepted frames in seconds."""
    good = [k for k, fault in enumerate(found) if fault is None]
    return max(b - a for a, b in pairwise([*good, len(found)])) / fps


def defocused(image):
    return cv2.GaussianBlur(image, (0, 0), 4 * max(image.shape) / 640)


def moved(image, down=False):
    """Blur a picture by a motion of a fortieth of its longer side during the exposure."""
    length = round(max(image.shape) / 40) | 1
    return cv2.blur(image, (1, length) if down else (length, 1))


def smoky(image, density=0.45, seed=0):
    """Add pale smoke of varying density to a picture."""
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
def test_sharpness_gate_withholds_no_frame_of_recordings(recordings_dir, name):
    assert set(faults(clip(recordings_dir, name))) == {None}


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("fault", FAULTS)
def test_sharpness_gate_reports_all_bad_frames_and_accepts_next_good_frame(recordings_dir, name, fault):
    spoil, reasons = FAULTS[fault]
    images = clip(recordings_dir, name)[:30]
    found = faults([*images[:15], *map(spoil, images[15:22]), *images[22:]])
    assert found[:15] + found[22:] == [None] * 23
    assert set(found[15:22]) <= reasons


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["cutting", "heart", "colon"])
def test_sharpness_gate_reports_smoke_in_recordings(recordings_dir, name):
    images = clip(recordings_dir, name)[:20]
    assert faults([*images[:15], *map(smoky, images[15:])])[15:] == ["smoke"] * 5


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_sharpness_gate_ignores_exposure_white_balance_and_tool(recordings_dir, name):
    images = list(clip(recordings_dir, name)[:30])
    half = images[20].copy()
    half[:, : half.shape[1] // 2] = (126, 129, 133)
    others = [brightened(images[20], gain) for gain in (1.5, 0.6, (1.2, 1.0, 0.8))]
    assert set(faults([*images[:20], half, *others])) == {None}


def test_sharpness_gate_reports_slowly_gathering_smoke():
    images = texture(1, 90, 320, 256)
    found = faults([smoky(image, 0.6 * max(0, k - 30) / 60) for k, image in enumerate(images)])
    assert found[:30] == [None] * 30 and set(found[70:]) == {"smoke"}


@pytest.mark.slow
def test_sharpness_gate_between_limits_keeps_previous_verdict():
    sharp = texture(2, 40, 320, 256)
    usual = appearance(sharp[0]).rows
    soft = []
    for image in sharp:
        widths = np.linspace(0.3, 3, 40)
        blurred = [cv2.GaussianBlur(image, (0, 0), width) for width in widths]
        soft.append(min(blurred, key=lambda each: abs(appearance(each).rows / usual - 0.785)))
    assert set(faults([*sharp[:10], *soft[10:20]])) == {None}
    assert faults([*sharp[:10], defocused(sharp[10]), *soft[11:14], sharp[14]])[10:] == ["blur"] * 4 + [None]


@pytest.mark.slow
@pytest.mark.parametrize("fps", [5.0, 30.0, 60.0])
@pytest.mark.parametrize("spoil", [defocused, smoky])
def test_sharpness_gate_permanent_change_withheld_two_seconds_at_most(fps, spoil):
    images = texture(3, 150, 320, 256)
    start = 20
    found = faults([*images[:start], *map(spoil, images[start:])], fps=fps)
    assert found[:start] == [None] * start and found[start] is not None
    assert longest(found, fps) <= 2.0
    until = start + round(2 * fps)
    assert set(found[until:]) <= {None}


@pytest.mark.slow
@pytest.mark.parametrize("fps", [5.0, 30.0])
def test_sharpness_gate_longest_interval_without_frame_is_bounded(fps):
    rng = np.random.default_rng(5)
    images = texture(6, 160, 320, 256)
    soft = [image if rng.random() < 0.35 else defocused(image) for image in images]
    slowly = [cv2.GaussianBlur(image, (0, 0), 0.3 + 3 * k / len(images)) for k, image in enumerate(images)]
    for stream in (soft, slowly):
        found = faults(stream, fps=fps)
        assert longest(found, fps) <= 1.2 and found.count("blur") <= len(found) / 2


@pytest.mark.recordings
@pytest.mark.parametrize("width", [1.0, 2.5, 5.0])
@pytest.mark.parametrize("name", PLACES)
def test_sharpness_gate_passes_soft_recording_but_not_sudden_blur(recordings_dir, name, width):
    images = [
        cv2.GaussianBlur(image, (0, 0), width * max(image.shape) / 640) for image in clip(recordings_dir, name)[:30]
    ]
    assert set(faults(images)) == {None}
    if width > 1 or name == "colon":
        return  # what is very soft already, as the rendered colon is, hardly changes by more blur
    found = faults([*images[:15], *map(defocused, images[15:20]), *images[20:]])
    assert found[:15] + found[20:] == [None] * 25 and set(found[15:20]) == {"blur"}


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize(("name", "most"), [("laparoscopy", 4), ("stereomis_like", 4), ("resting_bowel", 0)])
def test_sharpness_gate_withholds_few_frames_of_moving_scope(recordings_dir, name, most):
    frames = list(open_recording(recordings_dir / "others" / name / "video.mp4"))
    gate = SharpnessGate()
    found = [gate.fault(frame.image, frame.pts_ns) for frame in frames]
    assert len(found) - found.count(None) <= most
    assert longest(found, 5.0 if name != "resting_bowel" else 30.0) < 1.0


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["colonoscopy_a", "colonoscopy_b"])
def test_sharpness_gate_passes_short_colonoscopy_recordings(recordings_dir, name):
    paths = sorted((recordings_dir / "others" / name / "images").iterdir())
    assert set(faults([np.ascontiguousarray(cv2.imread(str(path))[..., ::-1]) for path in paths], fps=25.0)) == {None}


def test_sharpness_gate_unmeasurable_frames_keep_fault_briefly():
    images = texture(3, 20, 320, 256)
    flat = [np.full_like(images[0], 90)] * 80
    found = faults([*images, defocused(images[0]), *flat])
    assert found[20:40] == ["blur"] * 20 and found[-1] is None
    assert set(faults([*images, *flat])) == {None}


def test_sharpness_gate_usual_sharpness_window_is_time_not_frames():
    """Ordinary frames are examined a few times per second and all others always, so the window is measured in time, not in frames."""
    images = texture(7, 80, 320, 256)
    gate = SharpnessGate()
    for k in range(0, 30, 6):
        assert gate.fault(images[k], round(k / 30 * 1e9)) is None
    found = [gate.fault(defocused(images[k]), round(k / 30 * 1e9)) for k in range(30, 80)]
    assert 10 <= found.index(None) <= 25
    still = SharpnessGate()
    assert [still.fault(image, 0) for image in [*images[:10], *map(defocused, images[10:30])]].count(None) >= 10


def test_sharpness_gate_start_scene_resets_usual_sharpness():
    images = texture(8, 20, 320, 256)
    gate = SharpnessGate()
    for k, image in enumerate(images):
        gate.fault(image, k * 33_000_000)
    gate.start_scene()
    assert [gate.fault(defocused(image), (20 + k) * 33_000_000) for k, image in enumerate(images)] == [None] * 20


def test_sharpness_gate_ignores_masked_pixels():
    images = [image.copy() for image in texture(4, 20, 320, 256)]
    kept = np.ones(images[0].shape[:2], np.uint8)
    kept[:, :276] = 0
    for image in images[10:]:
        image[:, :270] = defocused(image)[:, :270]
    assert set(faults(images)[10:]) == {"blur"}
    assert set(faults(images, kept)) == {None}


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 2**32))
def test_sharpness_gate_accepts_images_of_any_size(height, width, seed):
    rng = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(changes, "RECENT_FRAMES", 1)
        patch.setattr(changes, "CLEAR_FRAMES", 2)
        gate = SharpnessGate()
        for k in range(6):
            image = rng.integers(0, rng.integers(1, 257), (height, width, 3), np.uint8)
            gate.fault(image, k, rng.integers(0, 2, (height, width), np.uint8) if rng.random() < 0.5 else None)


@pytest.mark.parametrize(
    ("before", "sharpness", "clear", "said"),
    [
        (None, 0.751, (1, 0.5, 20), None), (None, 0.75, (1, 0.5, 20), None), (None, 0.749, (1, 0.5, 20), "blur"),
        ("blur", 0.819, (1, 0.5, 20), "blur"), ("blur", 0.82, (1, 0.5, 20), None),
        (None, 1, (0.74, 0.39, 35), "smoke"), (None, 1, (0.75, 0.39, 35), None), (None, 1, (0.74, 0.4, 35), None),
        (None, 1, (0.74, 0.39, 34.9), None), ("smoke", 1, (0.86, 0.43, 20), "smoke"), ("smoke", 1, (0.87, 0.43, 20), None),
        ("smoke", 1, (0.5, 0.435, 20), None),
    ],
)  # fmt: skip
def test_sharpness_gate_blur_and_smoke_thresholds(before, sharpness, clear, said):
    """The usual values are a contrast of 1, a saturation of 0.5 and a haze of 20 levels."""
    gate = SharpnessGate()
    gate._clear[:5] = np.array([[0.2, 0.1, 1], [0.9, 0.45, 10], [1, 0.5, 20], [1.5, 0.8, 30], [2, 0.9, 90]])
    gate._clear_count, gate._fault = 5, before
    assert gate._judged(sharpness, np.array(clear, float)) == said


def gate_of(monkeypatch, seen):
    """Return a gate for which each frame has the next appearance of `seen`."""
    looks = iter(seen)
    monkeypatch.setattr(changes, "appearance", lambda image, kept: next(looks))
    return SharpnessGate()


SHARP = Appearance(0.4, 0.4, 1.0, 0.5, 20.0)


def test_sharpness_gate_keeps_fault_1_5_seconds_without_measurement(monkeypatch):
    blurred = Appearance(0.2, 0.4, 1.0, 0.5, 20.0)
    gate = gate_of(monkeypatch, [*[SHARP] * 10, blurred, *[None] * 20])
    said = [gate.fault(np.zeros((2, 2, 3), np.uint8), k * 140_000_000) for k in range(31)]
    assert said == [None] * 10 + ["blur"] * 11 + [None] * 10


def test_sharpness_gate_passes_first_five_frames_unconditionally(monkeypatch):
    blurred = Appearance(0.4, 0.2, 1.0, 0.5, 20.0)
    gate = gate_of(monkeypatch, [*[SHARP] * 4, blurred, blurred])
    said = [gate.fault(np.zeros((2, 2, 3), np.uint8), k * 30_000_000) for k in range(6)]
    assert said == [None] * 5 + ["blur"]


def test_sharpness_gate_clamps_intervals_to_1_ms_and_0_3_s(monkeypatch):
    gate = gate_of(monkeypatch, [SHARP] * 3)
    for pts_ns in (0, 0, 60_000_000_000):
        gate.fault(np.zeros((2, 2, 3), np.uint8), pts_ns)
    assert [each[0] for each in gate._recent] == pytest.approx([1e-3, 1e-3, 0.3])


@pytest.mark.parametrize(("fps", "frames"), [(2, 5), (10, 15), (30, 45)])
def test_sharpness_gate_window_is_1_5_seconds_and_five_frames_at_least(monkeypatch, fps, frames):
    gate = gate_of(monkeypatch, [SHARP] * 120)
    for k in range(120):
        gate.fault(np.zeros((2, 2, 3), np.uint8), round(k * 1e9 / fps))
    assert len(gate._recent) == pytest.approx(frames, abs=1)
    assert len(gate._clear) == 300 and gate._clear_count == 120


def waves(across, down, size=(256, 320), amplitude=50.0):
    y, x = np.mgrid[: size[0], : size[1]]
    grey = 128 + amplitude * (np.sin(2 * np.pi * x / across) + np.sin(2 * np.pi * y / down)) / 2
    return np.repeat(np.rint(grey)[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize(("across", "down"), [(32, 32), (40, 32), (64, 40)])
def test_appearance_sharpness_of_sine_waves_matches_closed_form(across, down):
    """The difference of a sine over d pixels has the amplitude 2 sin(pi d / period)."""
    seen = appearance(waves(across, down))
    expected = [np.sin(np.pi / period) / np.sin(8 * np.pi / period) for period in (down, across)]
    assert [seen.rows, seen.columns] == pytest.approx(expected, rel=0.06)


def test_appearance_measures_large_images_at_320_pixels():
    large = np.repeat(np.repeat(waves(40, 40), 4, 0), 4, 1)
    small, seen = appearance(waves(40, 40)), appearance(large)
    assert (seen.rows, seen.columns) == pytest.approx((small.rows, small.columns), rel=0.02)


def test_appearance_contrast_saturation_and_haze_of_two_colours():
    image = waves(32, 32, amplitude=4)[..., :1] - 128.0
    image = np.concatenate([image[:, :160] + [120, 60, 80], image[:, 160:] + [200, 100, 150]], axis=1)
    seen = appearance(np.rint(image).astype(np.uint8))
    grey = np.array([[120, 60, 80], [200, 100, 150]]) @ [0.299, 0.587, 0.114]
    assert seen.contrast == pytest.approx(np.log(grey[1] + 1) / 2 - np.log(grey[0] + 1) / 2, rel=0.03)
    assert seen.saturation == pytest.approx(0.5, abs=0.02) and seen.haze == pytest.approx(58, abs=2)


@pytest.mark.parametrize(("rows", "is_measured"), [(2, False), (26, True)])
def test_appearance_requires_usable_pixels(rows, is_measured):
    kept = np.zeros((256, 320), np.uint8)
    kept[100 : 100 + rows] = 1
    assert (appearance(waves(32, 32), kept) is not None) == is_measured
    dark = waves(32, 32)
    dark[kept == 0] = 5
    assert (appearance(dark) is not None) == is_measured


def test_appearance_of_flat_image_is_none():
    assert appearance(np.full((256, 320, 3), 120, np.uint8)) is None
    assert appearance(waves(32, 32, (16, 16))) is None and appearance(waves(32, 32, (18, 18))) is not None


def test_usual_sharpness_is_median_weighted_by_intervals():
    gate = SharpnessGate()
    gate._recent.extend([(0.1, 0.3, 0.9), (0.1, 0.4, 0.8), (1.0, 0.5, 0.2)])
    assert gate._usual_sharpness() == (0.5, 0.2)
    gate._recent.extend([(1.0, 0.3, 0.6), (1.0, 0.4, 0.7)])
    assert gate._usual_sharpness() == (0.4, 0.6)
