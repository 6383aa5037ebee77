"""Unusable sidecars, hostile arrays and JSON, and outward links in recordings: one error sentence each, no hang."""

from __future__ import annotations

import io
import json
import os
import struct
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting, RecordingError
from gsplat_core.io.recordings import open_recording, validate_recording

SIZE, COUNT = 32, 3


def _image(path: Path, value: int = 90) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((SIZE, SIZE), value, np.uint8))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A valid recording of three images with every sidecar."""
    folder = tmp_path / "rec"
    for index in range(COUNT):
        _image(folder / "images" / f"{index}.png")
        _image(folder / "images_right" / f"{index}.png")
        _image(folder / "masks" / f"{index}.png", 0)
        _image(folder / "depth" / f"{index}.png", 40)
    _image(folder / "valid_mask.png", 255)
    table = np.zeros((COUNT, 17))
    table[:, :15] = np.concatenate([np.eye(3), [[0], [0], [0]], [[SIZE], [SIZE], [30]]], axis=1).reshape(15)
    np.save(folder / "poses_bounds.npy", table)
    (folder / "recording.json").write_text('{"format": "intrasplat-recording", "version": 1, "depth_unit_mm": 1}')
    assert validate_recording(folder).problems == []
    return folder


def _refused(root: Path, *fragments: str) -> None:
    with pytest.raises(RecordingError) as caught:
        list(open_recording(root))
    for fragment in fragments:
        assert fragment in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000
    assert not validate_recording(root).ok


def _remove(path: Path) -> None:
    if path.is_dir():
        for part in path.iterdir():
            part.unlink()
        path.rmdir()
    else:
        path.unlink()


FOLDERS = ("masks", "depth", "images_right")
FILES = ("valid_mask.png", "poses_bounds.npy", "recording.json")
WRONG: dict[str, Callable[[Path], object]] = {
    "dangling link": lambda path: path.symlink_to("nowhere"),
    "link to itself": lambda path: path.symlink_to(path.name),
    "pipe": lambda path: os.mkfifo(path),
    "empty file": lambda path: path.touch(),
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.parametrize("name", (*FOLDERS, *FILES))
@pytest.mark.parametrize("kind", sorted(WRONG))
def test_unusable_sidecar_is_refused(root: Path, name: str, kind: str) -> None:
    _remove(root / name)
    assert validate_recording(root).ok  # absent is no error
    WRONG[kind](root / name)
    _refused(root, name)


@pytest.mark.parametrize("name", FILES)
def test_folder_in_place_of_sidecar_file_is_refused(root: Path, name: str) -> None:
    _remove(root / name)
    (root / name).mkdir()
    _refused(root, name)


@pytest.mark.parametrize("name", FOLDERS)
def test_empty_sidecar_folder_is_refused(root: Path, name: str) -> None:
    _remove(root / name)
    (root / name).mkdir()
    _refused(root, name, f"for {COUNT} frames")


@pytest.mark.parametrize("name", [*(f"{folder}/1.png" for folder in (*FOLDERS, "images")), *FILES])
@pytest.mark.parametrize("kind", ["dangling", "pipe", "out", "chain"])
def test_dangling_outward_and_chained_links_and_pipes_are_refused(
    root: Path, name: str, kind: str, tmp_path: Path
) -> None:
    path, outside = root / name, tmp_path / f"outside{Path(name).suffix}"
    path.rename(outside)
    if kind == "dangling":
        path.symlink_to("nowhere")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "out":
        path.symlink_to(outside)
    else:
        (root / "link").symlink_to(outside)
        path.symlink_to(root / "link")
    _refused(root, Path(name).name, *(["leads out"] if kind in ("out", "chain") else []))


@pytest.mark.parametrize("name", (*FOLDERS, "images"))
def test_sidecar_folder_linked_outside_is_refused(root: Path, name: str, tmp_path: Path) -> None:
    (root / name).rename(tmp_path / "outside")
    (root / name).symlink_to(tmp_path / "outside")
    _refused(root, name, "leads out")


def test_video_linked_outside_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rec").mkdir()
    (tmp_path / "secret.mp4").write_bytes(b"....ftyp")
    (tmp_path / "rec" / "video.mp4").symlink_to("../secret.mp4")
    _refused(tmp_path / "rec", "video.mp4", "leads out")


def test_sidecar_folder_linked_inside_recording_is_followed(root: Path) -> None:
    (root / "masks").rename(root / "real")
    (root / "masks").symlink_to("real")
    assert validate_recording(root).ok


def _npy(header: str, version: tuple[int, int] = (1, 0), data: bytes = b"") -> bytes:
    text = header.encode("latin-1")
    return b"\x93NUMPY" + bytes(version) + struct.pack("<H" if version[0] == 1 else "<I", len(text)) + text + data


def _zip() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.npy", b"x")
    return stream.getvalue()


def _saved(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


ARRAYS = {
    "zip": _zip(),
    "empty": b"",
    "magic alone": b"\x93NUMPY",
    "huge shape": _npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 17)}"),
    "shape beyond 64 bits": _npy(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({10**30}, 17)}}"),
    "negative shape": _npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-3, 17)}"),
    "shape of floats": _npy("{'descr': '<f8', 'fortran_order': False, 'shape': (3.0, 17)}"),
    "objects": _npy("{'descr': '|O', 'fortran_order': False, 'shape': (3, 17)}"),
    "records": _npy("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (3, 17)}"),
    "text": _npy("{'descr': '<U8', 'fortran_order': False, 'shape': (3, 17)}"),
    "unknown version": _npy("{}", (9, 0)),
    "long header": b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**31),
    "nested header": _npy("(" * 3000),
    "not a header": _npy("__import__('os').abort()"),
    "no array": _npy("[1, 2, 3]"),
    "NaN": _saved(np.full((COUNT, 17), np.nan)),
    "infinite": _saved(np.full((COUNT, 17), np.inf)),
    "one number": _saved(np.float64(3)),
    "complex": _saved(np.zeros((COUNT, 17), complex)),
    "huge numbers": _saved(np.full((COUNT, 17), 1e308)),
}


@pytest.mark.parametrize("kind", sorted(ARRAYS))
def test_malformed_poses_bounds_npy_is_refused(root: Path, kind: str) -> None:
    (root / "poses_bounds.npy").write_bytes(ARRAYS[kind])
    _refused(root, "poses_bounds.npy")


@pytest.mark.parametrize("kind", sorted(ARRAYS))
def test_malformed_depth_npy_is_refused(root: Path, kind: str) -> None:
    for index in range(COUNT):
        (root / "depth" / f"{index}.png").unlink()
        (root / "depth" / f"{index}.npy").write_bytes(ARRAYS[kind])
    _refused(root, "0.npy")


def test_depth_in_fortran_order_is_read_correctly(root: Path) -> None:
    depth = np.arange(SIZE * SIZE, dtype=np.float64).reshape(SIZE, SIZE)
    for index in range(COUNT):
        (root / "depth" / f"{index}.png").unlink()
        np.save(root / "depth" / f"{index}.npy", np.asfortranarray(depth))
    frame = next(iter(open_recording(root)))
    assert frame.depth is not None and np.array_equal(frame.depth, depth.astype(np.float32))


@pytest.mark.parametrize(
    "text",
    [
        '{"a": ' * 5000,
        "[" * 100_000,
        '{"format": "intrasplat-recording", "version": 1, "fps": ' + "9" * 5000 + "}",
        '{"format": "intrasplat-recording", "version": 1, "fps": 1e999}',
        '{"format": "intrasplat-recording", "version": 1, "fps": NaN}',
        '{"format": "intrasplat-recording", "version": 1, "fps": 30, "fps": 60}',
        '{"format": "intrasplat-recording", "version": 1, "camera": {"width": 32, "height": 32, "fx": 1e300, "fy": 1, "cx": 0, "cy": 0}}',
        '{"format": "intrasplat-recording", "version": 1, "camera": {"width": 1e300, "height": 32, "fx": 1, "fy": 1, "cx": 0, "cy": 0}}',
        "",
        "null",
    ],
)
def test_malformed_recording_json_is_refused(root: Path, text: str) -> None:
    (root / "recording.json").write_text(text)
    _refused(root, "recording.json")


@pytest.mark.parametrize(
    "change", [{"camera_to_world": [[1e308] * 4] * 3 + [[0, 0, 0, 1]]}, {"file": "\ud800.png"}, {"file": "a" * 5000}]
)
def test_cameras_json_with_invalid_pose_or_name_is_refused(root: Path, change: dict) -> None:
    entry = {"file": "images/0.png", "camera_to_world": np.eye(4).tolist()} | change
    camera = {"width": SIZE, "height": SIZE, "fx": 30, "fy": 30, "cx": 16, "cy": 16}
    (root / "cameras.json").write_text(json.dumps({**camera, "frames": [entry]}))
    _refused(root)


@pytest.mark.parametrize("scale", [60 * 1e6, 1e300, 1e-9, 0.1, 400.0, float("inf"), float("nan"), -1.0, 0.0])
def test_open_recording_rejects_scale_without_valid_image_size(root: Path, scale: float) -> None:
    with pytest.raises(InvalidSetting, match="scale"):
        open_recording(root, scale=scale)


def test_open_recording_states_size_for_too_large_scale(root: Path) -> None:
    with pytest.raises(InvalidSetting, match=r"9600x9600 px from 32x32.*at most 67108864 pixels"):
        open_recording(root, scale=300)
    assert open_recording(root, scale=2).width_px == 64


@pytest.mark.skipif(sys.platform == "darwin", reason="this file system takes no names that are not UTF-8")
@pytest.mark.parametrize("name", [b"caf\xe9", "größe 日本".encode(), b"a\nb", b"concat:x"])
def test_recording_folder_may_have_non_utf8_or_odd_name(root: Path, name: bytes) -> None:
    from tests.gsplat_core.io.recordings.videos import encode

    folder = Path(os.fsdecode(os.fsencode(root.parent) + b"/" + name))
    root.rename(folder)
    recording = open_recording(folder)
    assert len(list(recording)) == COUNT and len(recording.digest) == 64
    video = folder / "beside" / "v.mp4"
    video.parent.mkdir()
    encode(root.parent / "v.mp4", "mpeg4").rename(video)
    assert len(list(open_recording(video))) == 20 and len(open_recording(video).digest) == 64
    assert validate_recording(video).ok
