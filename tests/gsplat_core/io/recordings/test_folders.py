"""Image folders: the EndoNeRF layout, `cameras.json`, and images alone."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid, RecordingMissing
from gsplat_core.io.recordings import open_recording, validate_recording

Refused = Callable[..., str]


def test_endonerf_folder_fields_and_frames(endonerf_folder: Path, make: SimpleNamespace) -> None:
    recording = open_recording(endonerf_folder)
    assert recording.fields == {"mask", "pose", "depth", "right_image"}
    assert recording.camera.K[0, 0] == 50
    for index, frame in enumerate(recording):
        assert np.array_equal(frame.image, make.frame_image(index))
        assert frame.right_image is not None and np.array_equal(frame.right_image, frame.image)
        assert frame.depth is not None and frame.depth.dtype == np.float32
        assert frame.depth[0, 0] == 0 and frame.depth[1, 1] == 40 + index
        assert frame.mask is not None and frame.mask.dtype == np.uint8
        assert frame.mask[:, :12].max() == 0 and frame.mask[:, 12:].min() == 1
    assert index == 5
    assert any("unit of depth" in note for note in recording.notes)
    assert any("30 frames/s" in note for note in recording.notes)


def test_validation_report_of_a_good_recording(endonerf_folder: Path) -> None:
    report = validate_recording(endonerf_folder)
    assert report.ok and not report.problems
    facts = report.facts
    assert (facts["frames"], facts["frames_decoded"], facts["width_px"], facts["height_px"]) == (6, 6, 48, 40)
    assert facts["layout"] == "endonerf" and facts["calibration"] == "poses_bounds.npy"
    assert facts["fields"] == ["depth", "mask", "pose", "right_image"]
    assert facts["tool_share"] == pytest.approx(0.25) and facts["tissue_share"] == pytest.approx(0.75)
    assert facts["camera_moves"] is False
    json.dumps(facts)


@pytest.mark.parametrize("shade", [0, 255, None])
def test_frames_that_show_nothing_are_noted(tmp_path: Path, make: SimpleNamespace, shade: int | None) -> None:
    for index in range(4):
        empty = index < 3 if shade is None else True
        image = np.full((40, 48, 3), shade or 0, np.uint8) if empty else make.frame_image(index)
        cv2.imwrite(str(tmp_path / f"{index}.png"), image)
    report = validate_recording(tmp_path)
    expected = {0: "4 of 4 frames show nothing (black: 4)", 255: "4 of 4 frames show nothing (one colour: 4)"}
    said = expected.get(-1 if shade is None else shade, "3 of 4 frames show nothing (black: 3)")
    assert report.ok and any(said in str(each) for each in report.warnings)


def test_images_of_formats_that_are_not_read_are_noted(tmp_path: Path, make: SimpleNamespace) -> None:
    for name in ("01.png", "02.png", "03.tif", "04.BMP", "05.webp", "06.tiff", "._07.tif", "notes.txt"):
        (tmp_path / name).touch()
        if name.endswith(".png"):
            cv2.imwrite(str(tmp_path / name), make.frame_image(1))
    [note] = [note for note in open_recording(tmp_path).notes if "other formats" in note]
    assert "4 images of other formats (03.tif, 04.BMP, 05.webp, …). They are not read; convert them to PNG" in note


def test_cameras_json_intrinsics_poses_and_valid_mask(cameras_folder: Path, make: SimpleNamespace) -> None:
    recording = open_recording(cameras_folder)
    assert recording.frame_count == 5 and recording.fps == 20
    assert recording.camera.K.tolist() == [[50, 0, 23], [0, 51, 21], [0, 0, 1]]
    for index, frame in enumerate(recording):
        assert np.array_equal(frame.image, make.frame_image(index))
        # The camera is at +2 i, so the world moves by -2 i in its eyes.
        assert frame.pose is not None and frame.pose[:3, 3].tolist() == [-2 * index, 0, 0]
        assert recording.camera_at(index).position.tolist() == [2 * index, 0, 0]
        assert frame.mask is not None and frame.mask.sum() == (make.width - 10) * (make.height - 10)
        assert frame.mask[0, 0] == 0  # outside the scope's circle is not tissue
    assert validate_recording(cameras_folder).facts["camera_moves"] is True


def test_cameras_json_order_wins_over_names(cameras_folder: Path, make: SimpleNamespace) -> None:
    path = cameras_folder / "cameras.json"
    content = json.loads(path.read_text())
    content["frames"].reverse()
    path.write_text(json.dumps(content))
    assert np.array_equal(next(iter(open_recording(cameras_folder))).image, make.frame_image(4))


def test_valid_mask_is_joined_with_tool_masks(cameras_folder: Path, make: SimpleNamespace) -> None:
    make.masks(cameras_folder / "masks", 5)
    mask = next(iter(open_recording(cameras_folder))).mask
    assert mask is not None
    assert mask.sum() == (make.width - 12 - 5) * (make.height - 10)


def test_images_alone_sort_by_number(tmp_path: Path, make: SimpleNamespace) -> None:
    make.images(tmp_path, 12, "{}.png")
    (tmp_path / ".hidden.png").write_text("not an image")
    recording = open_recording(tmp_path)
    assert recording.frame_count == 12
    assert [int(frame.image[0, 0, 0]) for frame in recording] == [20 * index + 10 for index in range(12)]
    assert any("no calibration" in note and "no camera motion" in note for note in recording.notes)


def test_assumed_camera_note_excludes_stated_poses_and_camera(tmp_path: Path, make: SimpleNamespace) -> None:
    make.images(tmp_path, 3, "{}.png")
    np.save(tmp_path / "poses.npy", np.tile(np.eye(4), (3, 1, 1)))
    (note,) = (note for note in open_recording(tmp_path).notes if "no calibration" in note)
    assert "px is assumed" in note and "motion" not in note
    camera = {"width": make.width, "height": make.height, "fx": 70.0, "fy": 70.0, "cx": 20.0, "cy": 18.0}
    described = {"format": "intrasplat-recording", "version": 1, "camera": camera}
    (tmp_path / "recording.json").write_text(json.dumps(described))
    recording = open_recording(tmp_path)
    assert not any("no calibration" in note for note in recording.notes)
    assert recording.camera.K[0, 0] == 70.0
    assert validate_recording(tmp_path).facts["calibration"] == "poses.npy, and the camera of recording.json"


def test_grey_and_transparent_images_become_rgb(tmp_path: Path, make: SimpleNamespace) -> None:
    make.image(tmp_path / "0.png", np.full((make.height, make.width), 77, np.uint8))
    rgba = np.dstack([make.frame_image(1)[..., ::-1], np.full((make.height, make.width), 9, np.uint8)])
    cv2.imwrite(str(tmp_path / "1.png"), rgba)
    frames = list(open_recording(tmp_path))
    assert (frames[0].image == 77).all()
    assert np.array_equal(frames[1].image, make.frame_image(1))


def test_scale_keeps_masks_binary_and_depth_unmixed(endonerf_folder: Path) -> None:
    frame = next(iter(open_recording(endonerf_folder, scale=0.4)))
    assert frame.image.shape == (16, 19, 3)
    assert frame.mask is not None and set(np.unique(frame.mask)) == {0, 1}
    assert frame.depth is not None and set(np.unique(frame.depth)) <= {0.0, 40.0}


def test_truncated_png_is_refused_with_file_name(endonerf_folder: Path, refused: Refused) -> None:
    path = endonerf_folder / "images" / "frame-000003.color.png"
    path.write_bytes(path.read_bytes()[:-40])
    refused(endonerf_folder, RecordingInvalid, path.name, "ends too early")


def test_truncated_jpeg_is_refused(tmp_path: Path, make: SimpleNamespace, refused: Refused) -> None:
    rng = np.random.default_rng(0)
    make.image(tmp_path / "0.jpg", rng.integers(0, 255, (64, 64, 3), dtype=np.uint8))
    data = (tmp_path / "0.jpg").read_bytes()
    (tmp_path / "0.jpg").write_bytes(data[: len(data) // 2])
    refused(tmp_path, RecordingInvalid, "0.jpg", "ends too early")


def test_damaged_png_is_refused(tmp_path: Path, make: SimpleNamespace, refused: Refused) -> None:
    make.images(tmp_path, 2)
    data = bytearray((tmp_path / "000001.png").read_bytes())
    data[60:80] = bytes(20)
    (tmp_path / "000001.png").write_bytes(data)
    refused(tmp_path, RecordingInvalid, "000001.png", "damaged")


def test_images_of_different_sizes_are_refused(tmp_path: Path, make: SimpleNamespace, refused: Refused) -> None:
    make.images(tmp_path, 4)
    make.image(tmp_path / "000002.png", make.frame_image(2, 30, 20))
    refused(tmp_path, RecordingInvalid, "000002.png", "30x20", "48x40")


@pytest.mark.parametrize("last", [2 + 30 * 86_400, 10**20])
def test_image_numbers_spanning_more_than_a_day_are_refused(
    tmp_path: Path, make: SimpleNamespace, refused: Refused, last: int
) -> None:
    make.images(tmp_path, 3)
    make.image(tmp_path / f"{last}.png", make.frame_image(3))
    refused(tmp_path, RecordingInvalid, "after the first one, at 30 frames/s", "up to 86400 s")


def test_right_images_of_other_size_or_count_are_refused(
    endonerf_folder: Path, make: SimpleNamespace, refused: Refused
) -> None:
    make.image(endonerf_folder / "images_right" / "frame-000001.color.png", make.frame_image(1, 24, 20))
    refused(endonerf_folder, RecordingInvalid, "images_right", "24x20")
    (endonerf_folder / "images_right" / "frame-000005.color.png").unlink()
    refused(endonerf_folder, RecordingInvalid, "images_right", "5 right images for 6 frames")


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        ({"fx": None}, ["fx"]),
        ({"fx": -5}, ["fx = -5"]),
        ({"width": 47}, ["48x40", "47x40"]),
        ({"cx": float("nan")}, ["cx"]),
        ({"frames": []}, ["frames is []"]),
        ({"frames": [{"file": "images/000000.png"}]}, ["camera_to_world of frame 0 is None"]),
        ({"frames": [{"file": "images/000000.png", "camera_to_world": [[1, 2], [3, 4]]}]}, ["frame 0", "[[1, 2]"]),
        ({"frames": [{"file": "images/000000.png", "camera_to_world": (2 * np.eye(4)).tolist()}]}, ["frame 0"]),
        ({"frames": [{"file": "images/000000.png", "camera_to_world": np.eye(4).astype(str).tolist()}]}, ["[['1.0'"]),
        ({"frames": ["images/000000.png"]}, ["file of frame 0 is None"]),
        ({"fps_assumed": "fast"}, ["frame rate", "fast"]),
    ],
)
def test_invalid_cameras_json_is_refused(
    cameras_folder: Path, refused: Refused, change: dict, fragments: list[str]
) -> None:
    path = cameras_folder / "cameras.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    refused(cameras_folder, RecordingInvalid, *fragments)


def test_cameras_json_missing_key_or_file_is_refused(cameras_folder: Path, refused: Refused) -> None:
    path = cameras_folder / "cameras.json"
    content = json.loads(path.read_text())
    (cameras_folder / "images" / "000003.png").unlink()
    refused(cameras_folder, RecordingMissing, "000003.png", "frame 3")
    del content["fy"]
    path.write_text(json.dumps(content))
    refused(cameras_folder, RecordingInvalid, "cameras.json", "no fy")
    path.write_text("{ not json")
    refused(cameras_folder, RecordingInvalid, "cameras.json", "not JSON")


def test_mirrored_pose_in_cameras_json_is_refused(cameras_folder: Path, refused: Refused) -> None:
    path = cameras_folder / "cameras.json"
    content = json.loads(path.read_text())
    content["frames"][2]["camera_to_world"] = np.diag([1.0, 1, -1, 1]).tolist()
    path.write_text(json.dumps(content))
    refused(cameras_folder, RecordingInvalid, "frame 2 is not a rotation")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("orientation", [1, 6])
def test_exif_rotation_is_not_applied_and_noted(
    tmp_path: Path, make: SimpleNamespace, order: str, suffix: str, orientation: int
) -> None:
    mark = b"II*\0" if order == "<" else b"MM\0*"
    entries = struct.pack(order + "HHHIIHHIHH", 2, 0x010F, 4, 1, 7, 0x0112, 3, 1, orientation, 0)
    exif = mark + struct.pack(order + "I", 8) + entries + bytes(4)
    for index in range(3):
        path = tmp_path / f"{index}.{suffix}"
        make.image(path, make.frame_image(index))
        data = path.read_bytes()
        if suffix == "jpg":
            part, at = b"\xff\xe1" + struct.pack(">H", len(exif) + 8) + b"Exif\0\0" + exif, 2
        else:
            part, at = struct.pack(">I", len(exif)) + b"eXIf" + exif, 33
            part += struct.pack(">I", zlib.crc32(part[4:]))
        path.write_bytes(data[:at] + part + data[at:])
    recording = open_recording(tmp_path)
    assert any("0." + suffix in note and "orientation 6" in note for note in recording.notes) == (orientation == 6)
    assert next(iter(recording)).image.shape == (make.height, make.width, 3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, None),
        ({"cx": -3}, "principal point"),
        ({"fx": 0.001}, "across the width"),
        ({"fy": 1e6}, "across the height"),
    ],
)
def test_unusual_camera_intrinsics_are_noted(cameras_folder: Path, change: dict[str, float], said: str | None) -> None:
    path = cameras_folder / "cameras.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    notes = [note for note in open_recording(cameras_folder).notes if "cameras.json" in note]
    assert [said in note for note in notes] == [True] if said else not notes
