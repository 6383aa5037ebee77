"""Masks, depth and poses next to the images: accepted layouts, and the message for each mistake."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording, validate_recording

Refused = Callable[..., str]


def test_too_few_masks_are_refused(video_folder: Path, refused: Refused) -> None:
    (video_folder / "masks" / "000007.png").unlink()
    refused(video_folder, RecordingInvalid, "masks", "7 masks for 8 frames")


def test_empty_mask_folder_is_refused(video_folder: Path, refused: Refused) -> None:
    for path in (video_folder / "masks").iterdir():
        path.unlink()
    refused(video_folder, RecordingInvalid, "0 masks for 8 frames")


def test_gap_in_mask_numbers_is_refused(video_folder: Path, refused: Refused) -> None:
    """The count is right, the pairing is not."""
    (video_folder / "masks" / "000003.png").rename(video_folder / "masks" / "000008.png")
    refused(video_folder, RecordingInvalid, "000004.png", "number 4", "expected 3")


def test_masks_numbered_from_one_are_accepted(video_folder: Path) -> None:
    for index in reversed(range(8)):
        (video_folder / "masks" / f"{index:06d}.png").rename(video_folder / "masks" / f"{index + 1:06d}.png")
    assert validate_recording(video_folder).ok


def test_masks_of_other_size_are_refused(video_folder: Path, make: SimpleNamespace, refused: Refused) -> None:
    make.masks(video_folder / "masks", 8, size=(24, 20), tool_columns=4)
    refused(video_folder, RecordingInvalid, "masks/000000.png", "24x20", "48x40", "8 such files")


def test_inverted_masks_are_refused(video_folder: Path, make: SimpleNamespace, refused: Refused) -> None:
    make.masks(video_folder / "masks", 8, tool_columns=36)
    refused(video_folder, RecordingInvalid, "masks", "75%", "inverted")


def test_tool_filling_some_frames_is_not_reported_as_inverted(video_folder: Path, make: SimpleNamespace) -> None:
    for index in (2, 5):
        make.image(video_folder / "masks" / f"{index:06d}.png", np.full((make.height, make.width), 255, np.uint8))
    report = validate_recording(video_folder)
    assert report.ok and report.facts["tool_share"] == pytest.approx((6 * 0.25 + 2) / 8)


def test_non_binary_mask_is_refused(video_folder: Path, make: SimpleNamespace, refused: Refused) -> None:
    ramp = np.tile(np.arange(make.width, dtype=np.uint8), (make.height, 1))
    make.image(video_folder / "masks" / "000005.png", ramp)
    refused(video_folder, RecordingInvalid, "000005.png", "48 different values")


def test_colour_picture_as_mask_is_refused(video_folder: Path, make: SimpleNamespace, refused: Refused) -> None:
    make.image(video_folder / "masks" / "000005.png", make.frame_image(5))
    refused(video_folder, RecordingInvalid, "000005.png", "colour picture")


@pytest.mark.parametrize("tool", [1, 255])
def test_masks_of_three_equal_channels_are_accepted(video_folder: Path, make: SimpleNamespace, tool: int) -> None:
    mask = np.zeros((make.height, make.width, 3), np.uint8)
    mask[:, :12] = tool
    for index in range(8):
        make.image(video_folder / "masks" / f"{index:06d}.png", mask)
    for frame in open_recording(video_folder):
        assert frame.mask is not None and frame.mask.sum() == 36 * 40


def _edit(table: np.ndarray, row: int, column: int, value: float) -> np.ndarray:
    table = table.copy()
    table[row, column] = value
    return table


@pytest.mark.parametrize(
    ("wrong", "fragments"),
    [
        (lambda t: t[:5], ["5 poses for 8 frames"]),
        (lambda t: t[:, :15], ["[8, 15]", "[N, 17]"]),
        (lambda t: t.astype("U8"), ["<U8"]),
        (lambda t: _edit(t, 3, 3, np.nan), ["row 3", "NaN"]),
        (lambda t: _edit(t, 2, 0, 1.5), ["frame 2", "not a rotation"]),
        (lambda t: _edit(t, 2, 0, 1e200), ["frame 2", "not a rotation"]),
        (lambda t: _edit(t, 2, 0, -1.0), ["frame 2", "not a rotation"]),
        (lambda t: _edit(t, 4, 14, 51.0), ["differ between rows"]),
        (lambda t: t * np.where(np.isin(np.arange(17), [4, 9]), 2, 1), ["96x80", "48x40"]),
        (lambda t: t * np.where(np.arange(17) == 14, -1, 1), ["-50 px"]),
    ],
)
def test_invalid_poses_bounds_are_refused(
    video_folder: Path, refused: Refused, wrong: Callable[[np.ndarray], np.ndarray], fragments: list[str]
) -> None:
    path = video_folder / "poses_bounds.npy"
    np.save(path, wrong(np.load(path)))
    refused(video_folder, RecordingInvalid, "poses_bounds.npy", *fragments)


def test_poses_bounds_are_camera_to_world_without_permutation(video_folder: Path, make: SimpleNamespace) -> None:
    table = make.poses_bounds(video_folder / "poses_bounds.npy", 8)
    angle = 0.3
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    pose = np.hstack([turn, [[1], [2], [3]], [[40], [48], [50]]])
    table[6, :15] = pose.ravel()
    np.save(video_folder / "poses_bounds.npy", table)
    camera = open_recording(video_folder).camera_at(6)
    assert camera.position == pytest.approx([1, 2, 3])
    ahead = camera.world_to_camera @ [1 + np.sin(angle), 2, 3 + np.cos(angle), 1]
    assert ahead == pytest.approx([0, 0, 1, 1])  # the camera looks along +z


def test_truncated_poses_bounds_file_is_refused(video_folder: Path, refused: Refused) -> None:
    path = video_folder / "poses_bounds.npy"
    path.write_bytes(path.read_bytes()[:300])
    refused(video_folder, RecordingInvalid, "poses_bounds.npy", "not a plain NumPy array")


def test_mask_in_alpha_channel_is_refused(video_folder: Path, make: SimpleNamespace, refused: Refused) -> None:
    mask = np.zeros((make.height, make.width, 4), np.uint8)
    mask[:, :12, 3] = 255
    assert cv2.imwrite(str(video_folder / "masks" / "000003.png"), mask)
    refused(video_folder, RecordingInvalid, "masks/000003.png", "all of its pixels are 0", "alpha channel")
    mask[..., :3] = mask[..., 3:]
    assert cv2.imwrite(str(video_folder / "masks" / "000003.png"), mask)
    assert validate_recording(video_folder).ok


def test_depth_map_of_other_size_is_refused(endonerf_folder: Path, make: SimpleNamespace, refused: Refused) -> None:
    make.image(endonerf_folder / "depth" / "frame-000004.depth.png", np.ones((20, 24), np.uint8))
    refused(endonerf_folder, RecordingInvalid, "frame-000004.depth.png", "24x20", "48x40")


def test_coloured_depth_map_is_refused(endonerf_folder: Path, make: SimpleNamespace, refused: Refused) -> None:
    make.image(endonerf_folder / "depth" / "frame-000004.depth.png", make.frame_image(4))
    refused(endonerf_folder, RecordingInvalid, "frame-000004.depth.png", "colour picture")


def _npy_depths(folder: Path, depths: list[np.ndarray]) -> None:
    for path in (folder / "depth").iterdir():
        path.unlink()
    for index, depth in enumerate(depths):
        np.save(folder / "depth" / f"{index:06d}.npy", depth)


@pytest.mark.parametrize(("value", "shown"), [(1e10, "1e+10"), (3e38, "3e+38"), (1e-9, "1e-09")])
def test_depth_outside_supported_range_is_refused(
    endonerf_folder: Path, refused: Refused, value: float, shown: str
) -> None:
    depths = [np.full((40, 48), 40.0, np.float32) for _ in range(6)]
    depths[3][7, 9] = value
    _npy_depths(endonerf_folder, depths)
    refused(endonerf_folder, RecordingInvalid, "000003.npy", "1e-06 to 1e+09 mm", shown, "row 7, column 9")


def test_float64_npy_depth_is_read_as_float32(endonerf_folder: Path) -> None:
    depths = [np.full((40, 48), 40.125 + index, np.float64) for index in range(6)]
    _npy_depths(endonerf_folder, depths)
    for frame, depth in zip(open_recording(endonerf_folder), depths, strict=True):
        assert frame.depth is not None and frame.depth.dtype == np.float32 and np.array_equal(frame.depth, depth)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_nan_infinite_or_negative_depth_is_refused(endonerf_folder: Path, refused: Refused, value: float) -> None:
    depths = [np.full((40, 48), 40.0, np.float32) for _ in range(6)]
    depths[3][7, 9] = value
    _npy_depths(endonerf_folder, depths)
    refused(endonerf_folder, RecordingInvalid, "000003.npy", "1 pixels", "row 7, column 9")


def test_validation_lists_every_bad_frame(endonerf_folder: Path) -> None:
    depths = [np.full((40, 48), np.nan if index % 2 else 40.0, np.float32) for index in range(6)]
    _npy_depths(endonerf_folder, depths)
    report = validate_recording(endonerf_folder)
    assert [Path(problem.file).name for problem in report.problems] == ["000001.npy", "000003.npy", "000005.npy"]
    assert report.facts["frames_decoded"] == 3


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        ({"format": "other", "version": 1}, ["'other'"]),
        ({"format": "intrasplat-recording", "version": 2}, ["version 2"]),
        ({"format": "intrasplat-recording", "version": 1, "fps": 0}, ["fps is 0"]),
        ({"format": "intrasplat-recording", "version": 1, "depth_unit_mm": "small"}, ["depth_unit_mm", "small"]),
        ({"format": "intrasplat-recording", "version": 1, "camera": {"fx": 1}}, ["no width"]),
        ({"format": "intrasplat-recording", "version": 1, "camera": 5}, ["camera is 5"]),
        (
            {
                "format": "intrasplat-recording",
                "version": 1,
                "camera": {"width": 40, "height": 40, "fx": 1, "fy": 1, "cx": 0, "cy": 0},
            },
            ["40x40", "48x40"],
        ),
        (
            {
                "format": "intrasplat-recording",
                "version": 1,
                "camera": {"width": 48, "height": 40, "fx": 40, "fy": 40, "cx": 1.1e7, "cy": 20},
            },
            ["cx = 1.1e+07", "at most 1e+07 px from 0"],
        ),
    ],
)
def test_invalid_recording_json_is_refused(
    endonerf_folder: Path, refused: Refused, content: dict, fragments: list[str]
) -> None:
    (endonerf_folder / "recording.json").write_text(json.dumps(content))
    refused(endonerf_folder, RecordingInvalid, "recording.json", *fragments)


def test_recording_json_sets_rate_depth_unit_and_camera(endonerf_folder: Path) -> None:
    camera = {"width": 48, "height": 40, "fx": 60, "fy": 61, "cx": 22, "cy": 19}
    content = {"format": "intrasplat-recording", "version": 1, "fps": 10, "depth_unit_mm": 0.5, "camera": camera}
    (endonerf_folder / "recording.json").write_text(json.dumps(content))
    recording = open_recording(endonerf_folder)
    assert recording.fps == 10 and recording.notes == ()
    assert recording.camera.K.tolist() == [[60, 0, 22], [0, 61, 19], [0, 0, 1]]
    frame = list(recording)[1]
    assert frame.pts_ns == 100_000_000
    assert frame.depth is not None and frame.depth[1, 1] == 20.5


def test_recording_json_may_start_with_byte_order_mark(endonerf_folder: Path) -> None:
    text = json.dumps({"format": "intrasplat-recording", "version": 1, "fps": 10})
    (endonerf_folder / "recording.json").write_text(text, "utf-8-sig")
    assert open_recording(endonerf_folder).fps == 10


@pytest.mark.parametrize(
    ("depth_mm", "fragment"),
    [
        (0.99, "median depth is 0.99 mm"),
        (1.0, None),
        (1000.0, None),
        (1001.0, "is 1e+03 mm"),
        (0.0, "no depth is known"),
    ],
)
def test_implausible_depth_is_noted(endonerf_folder: Path, depth_mm: float, fragment: str | None) -> None:
    count = open_recording(endonerf_folder).frame_count
    shutil.rmtree(endonerf_folder / "depth")
    (endonerf_folder / "depth").mkdir()
    for index in range(count):
        depth = np.full((40, 48), depth_mm, np.float32)
        depth[:12] = 0  # unknown pixels do not count
        np.save(endonerf_folder / "depth" / f"{index:06d}.npy", depth)
    notes = [note for note in open_recording(endonerf_folder).notes if "frames looked at" in note]
    assert [fragment is not None and fragment in note for note in notes] == ([] if fragment is None else [True])
