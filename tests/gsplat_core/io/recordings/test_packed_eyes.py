"""Pictures that hold both eyes are warned of, and others are not."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording, validate_recording
from gsplat_core.io.recordings.packed_eyes import TWO_EYES, halves, similarity
from operators.sources.address import SourceOptions
from operators.sources.registry import open_source


def _textured(rng: np.random.Generator, width: int) -> np.ndarray:
    noise = rng.integers(0, 256, (160, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2) * 2


@pytest.mark.parametrize(("stereo", "axis"), [("side_by_side", 1), ("top_bottom", 0)])
def test_a_packed_pair_is_warned_of_until_it_is_split(tmp_path: Path, rng: np.random.Generator, stereo, axis) -> None:
    scene = _textured(rng, 220)
    left, right = scene[:, 16:216], scene[:, :200]
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), np.concatenate([left, right], axis))
    notes = [note for note in open_recording(tmp_path).notes if TWO_EYES in note]
    assert len(notes) == 1 and f'"stereo": "{stereo}"' in notes[0]
    split = open_source(f"recording:{tmp_path}?stereo={stereo}")
    assert "right_image" in split.description.fields
    assert not any(TWO_EYES in note for note in split.description.notes)


def _packed(folder: Path, rng: np.random.Generator, stereo: str, size: tuple[int, int] = (200, 160)) -> np.ndarray:
    axis = 1 if stereo == "side_by_side" else 0
    eyes = [_textured(rng, size[0])[: size[1]] for _ in range(2)]
    for number in range(3):
        cv2.imwrite(str(folder / f"{number:03d}.png"), np.concatenate(eyes, axis)[..., ::-1])
    return np.stack(eyes)


@pytest.mark.parametrize("shift", [0, 4])
@pytest.mark.parametrize("black", [False, True])
def test_packed_pair_is_noticed_if_shifted_vertically_or_after_black_pictures(
    tmp_path: Path, rng: np.random.Generator, shift: int, black: bool
) -> None:
    scene = _textured(rng, 220)
    packed = np.concatenate([scene[: 160 - shift, 16:216], scene[shift:, :200]], 1)
    for number in range(12):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), packed * (number > 9 or not black))
    notes = [note for note in open_recording(tmp_path).notes if TWO_EYES in note]
    assert len(notes) == 1
    # The note's text is a complete recording.json.
    (tmp_path / "recording.json").write_text(re.search(r"{.*}", notes[0])[0])  # type: ignore[index]
    recording = open_recording(tmp_path)
    assert recording.width_px == 200 and not any(TWO_EYES in note for note in recording.notes)


def test_note_on_cameras_json_does_not_propose_stereo_entry(tmp_path: Path, rng: np.random.Generator) -> None:
    scene = _textured(rng, 220)
    cv2.imwrite(str(tmp_path / "0.png"), np.concatenate([scene[:, 16:216], scene[:, :200]], 1))
    camera = {"width": 400, "height": 160, "fx": 300, "fy": 300, "cx": 200, "cy": 80}
    frame = {"file": "0.png", "camera_to_world": np.eye(4).tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps(camera | {"frames": [frame]}))
    [note] = [note for note in open_recording(tmp_path).notes if TWO_EYES in note]
    assert "images_right/" in note and "recording.json" not in note


@pytest.mark.parametrize(("stereo", "size"), [("side_by_side", (161, 401)), ("top_bottom", (321, 200))])
def test_middle_row_or_column_of_odd_pictures_is_left_out(
    tmp_path: Path, rng: np.random.Generator, stereo: str, size: tuple[int, int]
) -> None:
    image = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "0.png"), image[..., ::-1])
    height, width = size[0] // (2 if stereo == "top_bottom" else 1), 200
    eyes = (image[:height, :width], image[height : 2 * height, :width] if stereo == "top_bottom" else image[:, 200:400])
    split = open_source(f"recording:{tmp_path}?stereo={stereo}")
    (tmp_path / "recording.json").write_text(
        json.dumps({"format": "intrasplat-recording", "version": 1, "stereo": stereo})
    )
    with closing(split), closing(open_source(f"recording:{tmp_path}")) as stated:
        for source in (split, stated):
            source.open()
            frame = source.read(30)
            assert frame is not None and frame.right_image is not None
            np.testing.assert_array_equal(frame.image, eyes[0])
            np.testing.assert_array_equal(frame.right_image, eyes[1])


@pytest.mark.parametrize("stereo", ["side_by_side", "top_bottom"])
def test_recording_json_splits_pictures_into_two_eyes(tmp_path: Path, rng: np.random.Generator, stereo: str) -> None:
    eyes = _packed(tmp_path, rng, stereo)
    description = {
        "format": "intrasplat-recording",
        "version": 1,
        "stereo": stereo,
        "stereo_baseline_mm": 4.0,
        "fps": 25,
    }
    (tmp_path / "recording.json").write_text(json.dumps(description))
    recording = open_recording(tmp_path)
    assert (recording.width_px, recording.height_px, recording.camera.K[0, 2]) == (200, 160, 100)
    assert not any(TWO_EYES in note for note in recording.notes)
    frames = list(recording)
    assert len(frames) == 3
    for frame in frames:
        assert frame.right_image is not None and frame.right_camera is not None
        np.testing.assert_array_equal(np.stack([frame.image, frame.right_image]), eyes)


@pytest.mark.parametrize(
    ("stereo", "said"),
    [("left_right", "Give side_by_side or top_bottom"), (1, "stereo is 1"), ("side_by_side", "1x200 px")],
)
def test_unusable_stereo_entry_is_refused(
    tmp_path: Path, stereo: object, said: str, refused: Callable[..., str]
) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.full((200, 1, 3), 90, np.uint8))
    description = {"format": "intrasplat-recording", "version": 1, "stereo": stereo}
    (tmp_path / "recording.json").write_text(json.dumps(description))
    refused(tmp_path, RecordingInvalid, "recording.json", said)
    report = validate_recording(tmp_path)
    assert len(report.problems) == 1 and not any(TWO_EYES in str(each) for each in report.warnings)


@pytest.mark.parametrize("beside", ["cameras.json", "images_right", "left and right"])
def test_stereo_entry_beside_other_eyes_or_cameras_is_refused(
    tmp_path: Path, rng: np.random.Generator, beside: str, refused: Callable[..., str]
) -> None:
    names = ["0_left.png", "0_right.png"] if beside == "left and right" else ["0.png"]
    for name in names:
        cv2.imwrite(str(tmp_path / name), _textured(rng, 320))
    if beside == "images_right":
        (tmp_path / beside).mkdir()
        cv2.imwrite(str(tmp_path / beside / "0.png"), _textured(rng, 320))
    elif beside == "cameras.json":
        camera = {"width": 320, "height": 160, "fx": 300, "fy": 300, "cx": 160, "cy": 80}
        frame = {"file": "0.png", "camera_to_world": np.eye(4).tolist()}
        (tmp_path / beside).write_text(json.dumps(camera | {"frames": [frame]}))
    (tmp_path / "recording.json").write_text(
        '{"format": "intrasplat-recording", "version": 1, "stereo": "side_by_side"}'
    )
    refused(tmp_path, RecordingInvalid, "states stereo 'side_by_side'", "Remove one of them")


def test_damaged_packed_picture_is_reported_once(tmp_path: Path, rng: np.random.Generator) -> None:
    _packed(tmp_path, rng, "side_by_side")
    (tmp_path / "recording.json").write_text(
        '{"format": "intrasplat-recording", "version": 1, "stereo": "side_by_side"}'
    )
    data = (tmp_path / "001.png").read_bytes()
    (tmp_path / "001.png").write_bytes(data[: len(data) // 2] + bytes(40) + data[len(data) // 2 + 40 :])
    problems = validate_recording(tmp_path).problems
    assert len(problems) == 1 and "001.png" in str(problems[0])


@pytest.mark.parametrize("scale", [1.0, 0.51, 0.13])
def test_address_splits_a_scaled_recording_with_the_assumed_camera(
    tmp_path: Path, rng: np.random.Generator, scale: float
) -> None:
    _packed(tmp_path, rng, "side_by_side", (200, 151))
    with closing(open_source(f"recording:{tmp_path}?stereo=side_by_side", SourceOptions(scale))) as source:
        about = source.description
        assert (about.width_px, about.height_px) == (round(200 * scale), round(151 * scale))
        assert about.camera.K[0, 2] == pytest.approx(about.width_px / 2)
        assert any("f = 180.0 px" in note for note in about.notes)
        source.open()
        frame = source.read(30)
        assert frame is not None and frame.right_image is not None
        assert frame.image.shape == frame.right_image.shape == (about.height_px, about.width_px, 3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_one_eye_is_not_warned_of(tmp_path: Path, rng: np.random.Generator, mirrored: bool) -> None:
    half = _textured(rng, 200)
    other = half[:, ::-1] if mirrored else _textured(rng, 200)
    cv2.imwrite(str(tmp_path / "0.png"), np.concatenate([half, other], 1))
    assert not any(TWO_EYES in note for note in open_recording(tmp_path).notes)


@pytest.mark.parametrize("size", [(16, 16), (1, 640), (640, 1), (200, 300)])
def test_pictures_without_texture_are_not_compared(size: tuple[int, int]) -> None:
    for layout in ("side_by_side", "top_bottom"):
        assert similarity(*halves(np.zeros((*size, 3), np.uint8), layout)) is None


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["scared_pair", "others/organ_still", "hamlyn_pair", "heart"])
def test_real_pairs_are_warned_of_when_packed(recordings_dir: Path, tmp_path: Path, name: str) -> None:
    frame = next(iter(open_recording(recordings_dir / name)))
    assert frame.right_image is not None
    for folder, axis in (("beside", 1), ("above", 0)):
        packed = np.concatenate([frame.image, frame.right_image], axis)
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "0.png"), packed[..., ::-1])
        assert any(TWO_EYES in note for note in open_recording(tmp_path / folder).notes)


@pytest.mark.recordings
@pytest.mark.parametrize(
    "name",
    ["cutting", "heart", "sinus", "colon"]
    + [
        f"others/{name}"
        for name in ("laparoscopy", "resting_bowel", "stereomis_like", "colonoscopy_a", "pelvis_stills")
    ],
)
def test_real_recordings_of_one_eye_are_not_warned_of(recordings_dir: Path, name: str) -> None:
    assert not any(TWO_EYES in note for note in open_recording(recordings_dir / name).notes)
