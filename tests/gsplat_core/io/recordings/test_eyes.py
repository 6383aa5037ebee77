"""Neighbouring files of two eyes are read as a stereo pair."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid, RecordingMissing
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.layouts import split_eyes
from tests.gsplat_core.io.recordings.test_stereo_calibration import scared_json
from tests.gsplat_core.io.recordings.videos import FRAMES, write_timed


def names(*texts):
    return [Path(text) for text in texts]


@pytest.mark.parametrize(
    "files",
    [
        ("left.png", "right.png"),
        ("Left_Image.png", "Right_Image.png"),
        ("f7_dynamic_L_0100.png", "f7_dynamic_R_0100.png"),
        ("000001_left.jpg", "000001_right.jpg"),
    ],
)
def test_split_eyes_by_file_names(files):
    eyes = split_eyes(names(*files, "notes.png"))
    assert (eyes.left, eyes.right, eyes.others) == ((Path(files[0]),), (Path(files[1]),), (Path("notes.png"),))


@pytest.mark.parametrize(
    "files",
    [
        ("0001.png", "0002.png"),
        ("left.png",),
        ("left.png", "right.jpg"),
        ("L_1.png", "L_2.png", "R_1.png"),
        ("bladder.png", "colr.png"),
    ],
)
def test_split_eyes_is_none_without_pairs(files):
    assert split_eyes(names(*files)) is None


def picture(path, value=120, size=(320, 256)):
    image = np.full((size[1], size[0], 3), value, np.uint8)
    image[40:50, 60:70] = 255
    cv2.imwrite(str(path), image)


def test_left_and_right_images_open_as_stereo_recording(tmp_path):
    for k in range(2):
        picture(tmp_path / f"{k}_left.png", 100 + k)
        picture(tmp_path / f"{k}_right.png", 200 + k)
    recording = open_recording(tmp_path)
    frames = list(recording)
    assert recording.frame_count == 2 and "right_image" in recording.fields
    assert [frame.image[0, 0, 0] for frame in frames] == [100, 101]
    assert [frame.right_image[0, 0, 0] for frame in frames] == [200, 201]
    assert frames[0].right_camera is None
    assert any("the two eyes have no calibration" in note for note in recording.notes)


@pytest.mark.parametrize(("baseline_mm", "is_noted"), [(0.0044, True), (0.5, False), (100.0, False), (4400.0, True)])
def test_implausible_stereo_baseline_is_noted(tmp_path, baseline_mm, is_noted):
    picture(tmp_path / "left.png")
    picture(tmp_path / "right.png")
    content = {"format": "intrasplat-recording", "version": 1, "stereo_baseline_mm": baseline_mm}
    (tmp_path / "recording.json").write_text(json.dumps(content))
    notes = [note for note in open_recording(tmp_path).notes if "mm apart" in note]
    assert [f"the two eyes are {baseline_mm:.3g} mm apart" in note for note in notes] == [True] * is_noted


def test_stereo_calibration_rectifies_images_and_sets_right_camera(tmp_path):
    picture(tmp_path / "left.png")
    picture(tmp_path / "right.png")
    without = open_recording(tmp_path).digest
    scared_json(tmp_path)
    recording = open_recording(tmp_path, scale=0.5)
    frame = next(iter(recording))
    assert frame.right_camera is not None and (frame.right_camera.K == recording.camera.K).all()
    assert np.isclose(recording.stereo_baseline_mm, np.linalg.norm([4.0, 0.1, 0.2]))
    assert frame.loss_mask is not None and frame.loss_mask.shape == (128, 160)
    assert not any("no calibration" in note for note in recording.notes)
    assert recording.digest != without


def test_depth_of_unrectified_pictures_is_refused(tmp_path):
    picture(tmp_path / "left.png")
    picture(tmp_path / "right.png")
    scared_json(tmp_path)
    (tmp_path / "depth").mkdir()
    cv2.imwrite(str(tmp_path / "depth" / "0.png"), np.ones((256, 320), np.uint8))
    with pytest.raises(RecordingInvalid, match="depth for pictures that are not rectified"):
        open_recording(tmp_path)


def test_stereo_calibration_of_other_size_is_refused(tmp_path):
    picture(tmp_path / "left.png", size=(100, 80))
    picture(tmp_path / "right.png", size=(100, 80))
    scared_json(tmp_path)
    with pytest.raises(RecordingInvalid, match=r"principal point .* is outside"):
        open_recording(tmp_path)


@pytest.mark.parametrize(("rate", "is_open"), [(25, True), (30, False), (24, False)])
def test_videos_of_two_eyes_must_have_one_frame_rate(tmp_path, rate, is_open):
    write_timed(tmp_path / "left.mp4", list(range(FRAMES)))
    write_timed(tmp_path / "right.mp4", list(range(FRAMES)), rate, Fraction(1, rate))
    if is_open:
        assert next(iter(open_recording(tmp_path))).right_image is not None
        return
    with pytest.raises(RecordingInvalid, match=f"right.mp4.*it has {rate} frames/s, left.mp4 has 25"):
        open_recording(tmp_path)


@pytest.mark.parametrize("folder", ["", "images"])
def test_error_names_pictures_of_other_formats(tmp_path, folder):
    place = tmp_path / folder
    place.mkdir(exist_ok=True)
    cv2.imwrite(str(place / "000.tiff"), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(RecordingMissing, match=r"no PNG or JPEG images: found 000\.tiff"):
        open_recording(tmp_path)


@pytest.mark.recordings
def test_left_and_right_videos_open_as_stereo_recording(recordings_dir):
    recording = open_recording(recordings_dir / "heart", max_frames=2)
    frames = list(recording)
    assert len(frames) == 2 and all(frame.right_image is not None for frame in frames)
    assert (frames[0].image != frames[0].right_image).any()


@pytest.mark.slow
@pytest.mark.recordings
def test_scared_raw_rectification_error_is_at_most_half_a_pixel(recordings_dir):
    frame = next(iter(open_recording(recordings_dir / "scared_raw")))
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (frame.image, frame.right_image)]
    finder = cv2.SIFT.create(2000)
    (here, left), (there, right) = (finder.detectAndCompute(each, None) for each in grey)
    pairs = [a for a, b in cv2.BFMatcher().knnMatch(left, right, k=2) if a.distance < 0.75 * b.distance]
    lower = np.array([there[pair.trainIdx].pt[1] - here[pair.queryIdx].pt[1] for pair in pairs])
    assert len(lower) > 300 and np.median(np.abs(lower)) <= 0.5
