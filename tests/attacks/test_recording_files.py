"""Hostile recordings: paths out of the folder, pickles, memory exhaustion and network references."""

from __future__ import annotations

import json
import os
import pickle
import struct
import zlib
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingError, RecordingInvalid, RecordingMissing
from gsplat_core.io.recordings import open_recording, validate_recording
from gsplat_core.io.recordings.plain_files import MAX_PIXELS

SIZE = 32


def _refused(path: Path, *fragments: str, error: type[RecordingError] = RecordingInvalid) -> None:
    with pytest.raises(error) as caught:
        for _ in open_recording(path):
            pass
    for fragment in fragments:
        assert fragment in str(caught.value)
    assert str(caught.value) in [str(problem) for problem in validate_recording(path).problems]


def _image(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((SIZE, SIZE, 3), 90, np.uint8))
    return path


def _cameras(root: Path, name: object) -> None:
    root.mkdir(exist_ok=True)
    camera = {"width": SIZE, "height": SIZE, "fx": 30, "fy": 30, "cx": 16, "cy": 16}
    frames = [{"file": name, "camera_to_world": np.eye(4).tolist()}]
    (root / "cameras.json").write_text(json.dumps({**camera, "frames": frames}))


@pytest.mark.parametrize(
    "name",
    [
        "../secret.png",
        "images/../../secret.png",
        "{absolute}",
        "C:\\secret.png",
        "..\\secret.png",
        "\\\\host\\share\\secret.png",
        "images/\0.png",
        "",
        None,
        5,
        ["images/0.png"],
    ],
)
def test_cameras_json_with_file_name_outside_recording_is_refused(tmp_path: Path, name: object) -> None:
    secret = _image(tmp_path / "secret.png")
    _cameras(tmp_path / "rec", str(secret) if name == "{absolute}" else name)
    _refused(tmp_path / "rec", "cameras.json", "file of frame 0")


def test_image_link_leading_out_of_recording_is_refused(tmp_path: Path) -> None:
    secret = _image(tmp_path / "secret.png")
    _cameras(tmp_path / "rec", "innocent.png")
    (tmp_path / "rec" / "innocent.png").symlink_to(secret)
    _refused(tmp_path / "rec", "innocent.png", "leads out")


def test_folder_link_leading_out_of_recording_is_refused(tmp_path: Path) -> None:
    _image(tmp_path / "elsewhere" / "0.png")
    _cameras(tmp_path / "rec", "images/0.png")
    (tmp_path / "rec" / "images").symlink_to(tmp_path / "elsewhere")
    _refused(tmp_path / "rec", "leads out")


def test_link_inside_recording_is_followed(tmp_path: Path) -> None:
    _cameras(tmp_path / "rec", "images/0.png")
    _image(tmp_path / "rec" / "raw" / "0.png")
    (tmp_path / "rec" / "images").symlink_to("raw")
    assert len(list(open_recording(tmp_path / "rec"))) == 1


def test_recording_with_link_loop_is_refused(tmp_path: Path) -> None:
    _cameras(tmp_path / "rec", "loop.png")
    (tmp_path / "rec" / "loop.png").symlink_to("loop.png")
    _refused(tmp_path / "rec", "loop.png", "frame 0")
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    _refused(tmp_path / "a", error=RecordingMissing)
    images = tmp_path / "images_only"
    images.mkdir()
    (images / "0.png").symlink_to("0.png")
    _refused(images, "0.png", error=RecordingError)


def test_recording_with_pipe_as_file_is_refused_without_hang(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "0.png")
    _refused(tmp_path, "0.png", "not a plain file")
    os.mkfifo(tmp_path / "video.mp4")
    _refused(tmp_path, "video.mp4", "not a plain file")
    (tmp_path / "video.mp4").unlink()
    (tmp_path / "0.png").unlink()
    _image(tmp_path / "0.png")
    os.mkfifo(tmp_path / "cameras.json")
    _refused(tmp_path, "cameras.json")


class _Bomb:
    def __reduce__(self) -> tuple:
        return os.mkdir, (self.target,)

    def __init__(self, target: str) -> None:
        self.target = target


@pytest.mark.parametrize("how", ["object array", "bare pickle"])
@pytest.mark.parametrize("name", ["poses_bounds.npy", "depth/0.npy"])
def test_recording_with_pickled_array_is_refused_without_executing(tmp_path: Path, how: str, name: str) -> None:
    root, target = tmp_path / "rec", tmp_path / "executed"
    _image(root / "images" / "0.png")
    path = root / name
    path.parent.mkdir(exist_ok=True)
    if how == "object array":
        np.save(path, np.array([_Bomb(str(target))], dtype=object), allow_pickle=True)
    else:
        path.write_bytes(pickle.dumps(_Bomb(str(target))))
    _refused(root, path.name)
    assert not target.exists()


def _png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(64))) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(100_000, 100_000), (2**31 - 1, 1), (0, 5), (MAX_PIXELS + 1, 1)])
def test_image_over_pixel_limit_is_refused_by_header(tmp_path: Path, size: tuple[int, int]) -> None:
    (tmp_path / "0.png").write_bytes(_png(*size))
    _refused(tmp_path, "0.png", f"{size[0]}x{size[1]} pixels")


def test_huge_npy_array_is_refused_by_header(tmp_path: Path) -> None:
    _image(tmp_path / "images" / "0.png")
    for name, shape in (("poses_bounds.npy", (10**9, 17)), ("depth/0.npy", (10**6, 10**6))):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
        # A sparse file: as large as it says, without taking space.
        with path.open("wb") as stream:
            stream.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode())
            if name == "poses_bounds.npy":
                stream.truncate(stream.tell() + shape[0] * shape[1] * 8)
        _refused(tmp_path, path.name)
        path.unlink()


@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n#EXT-X-ENDLIST\n",
        "ffconcat version 1.0\nfile '/etc/passwd'\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\n",
        '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011"><BaseURL>http://127.0.0.1:9/</BaseURL></MPD>',
    ],
)
@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv"])
def test_playlist_as_video_is_refused_before_decoder(
    tmp_path: Path, text: str, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reached(*_: object) -> None:
        raise AssertionError("the decoder was given a playlist")

    monkeypatch.setattr(av, "open", reached)
    (tmp_path / f"video{suffix}").write_text(text)
    _refused(tmp_path / f"video{suffix}", "is not a video")


@pytest.mark.parametrize(
    "text",
    ["[" * 200_000, '{"frames": ' * 50_000, "[1, 2]", '"x"', "\ud800".encode("utf-8", "surrogatepass"), b"\xff\xfe"],
)
def test_malformed_cameras_json_is_refused(tmp_path: Path, text: str | bytes) -> None:
    path = tmp_path / "cameras.json"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    _refused(tmp_path, "cameras.json")


def test_cameras_json_with_non_finite_or_huge_numbers_is_refused(tmp_path: Path) -> None:
    _image(tmp_path / "0.png")
    for value in ("1e999", "1" + "0" * 400, "-1e308", "true", "NaN"):
        camera = f'{{"width": 32, "height": 32, "fx": {value}, "fy": 30, "cx": 16, "cy": 16, "frames": [1]}}'
        (tmp_path / "cameras.json").write_text(camera)
        _refused(tmp_path, "cameras.json")
