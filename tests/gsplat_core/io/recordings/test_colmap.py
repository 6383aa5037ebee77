"""Scenes in COLMAP's format, as text and binary, and hostile ones."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from gsplat_core import Camera
from gsplat_core.errors import RecordingError, RecordingInvalid, RecordingMissing
from gsplat_core.io.recordings.colmap import read_colmap
from tests.colmap_writer import write_scene

POINTS = [(1.0, 2.0, 3.0, 255, 0, 7), (-1.0, 0.5, 9.0, 1, 2, 3)]


def cameras(count=5):
    generator = np.random.default_rng(0)
    for k in range(count):
        pose = np.eye(4)
        pose[:3, :3], _ = cv2.Rodrigues(generator.normal(size=3))
        pose[:3, 3] = generator.normal(size=3)
        yield (
            f"set/{(7 * k) % count:03d}.png",
            Camera(np.array([[50.0 + k, 0, 20], [0, 50.0 + k, 15], [0, 0, 1]]), 40, 30, pose),
        )


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE"])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_read_colmap_returns_cameras_and_points_in_name_order(tmp_path, text, model, place):
    written = list(cameras())
    write_scene(tmp_path / "scene" / place, written, text=text, points=POINTS, model=model)
    scene = read_colmap(tmp_path / "scene")
    assert [each.name for each in scene.images] == sorted(name for name, _ in written)
    for each in scene.images:
        wanted = dict(written)[each.name]
        assert np.allclose(each.camera.world_to_camera, wanted.world_to_camera, atol=1e-9)
        assert np.array_equal(each.camera.K, wanted.K) and each.camera.width_px == 40
    positions, colours = scene.points()
    assert positions.tolist() == [list(p[:3]) for p in POINTS] and colours.tolist() == [list(p[3:]) for p in POINTS]
    assert [each.name for each in scene.held_out(2)] == sorted(dict(written))[::2]


@pytest.mark.parametrize("text", [True, False])
def test_read_colmap_refuses_distorted_lens_model(tmp_path, text):
    write_scene(tmp_path / "sparse", cameras(), text=text, model="OPENCV")
    with pytest.raises(RecordingInvalid, match=r"lens model OPENCV.*image_undistorter"):
        read_colmap(tmp_path)


def test_read_colmap_refuses_missing_or_empty_scene(tmp_path):
    with pytest.raises(RecordingMissing, match="no scene of COLMAP"):
        read_colmap(tmp_path)
    (tmp_path / "cameras.txt").write_text("")
    with pytest.raises(RecordingMissing, match="images"):
        read_colmap(tmp_path)
    (tmp_path / "images.txt").write_text("\n\n")
    with pytest.raises(RecordingInvalid, match="no images"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("file", "change", "reason"),
    [
        ("cameras.bin", lambda b: b[:-1], "cut short"),
        ("cameras.bin", lambda b: struct.pack("<Q", 2**60) + b[8:], "do not fit"),
        ("cameras.bin", lambda b: b[:12] + struct.pack("<i", 99) + b[16:], "number 99"),
        ("cameras.bin", lambda b: b[:16] + struct.pack("<Q", 2**40) + b[24:], "1099511627776x30"),
        ("cameras.bin", lambda b: b[:32] + struct.pack("<d", float("nan")) + b[40:], "must be below"),
        ("cameras.bin", lambda b: b[:32] + struct.pack("<d", -5.0) + b[40:], "at least 0.001 px"),
        ("images.bin", lambda b: b[:-1], "cut short"),
        ("images.bin", lambda b: b[:12] + struct.pack("<4d", 0, 0, 0, 0) + b[44:], "no rotation"),
        ("images.bin", lambda b: b.replace(b"set/", b"../_"), "not inside images"),
        ("images.bin", lambda b: b[:68] + struct.pack("<i", 7) + b[72:], "camera 7"),
        ("images.bin", lambda b: b[:72] + b"x" * 10_000, "cut short"),
    ],
)
def test_read_colmap_refuses_malformed_binary_scene(tmp_path, file, change, reason):
    write_scene(tmp_path / "sparse", cameras(), text=False)
    path = tmp_path / "sparse" / file
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(RecordingInvalid, match=reason) as raised:
        read_colmap(tmp_path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        ("cameras.txt", "PINHOLE 40", "PINHOLE wide", "line 2"),
        ("cameras.txt", " 15.0", "", "3 parameters"),
        ("images.txt", " 10 set", " ten set", "line 2"),
        ("images.txt", " 10 set", " set", "line 2"),
        ("images.txt", " 10 set/", " 10 /", "not inside images"),
        ("images.txt", "\n\n", "\n", "line 3 lists no points of the image in the line before"),
        ("cameras.txt", "20 PINHOLE", "10 PINHOLE", "defines camera 10 twice"),
        ("cameras.txt", "PINHOLE 40 30 50.0", "PINHOLE 40 30 1e-4", "0.0001 and 50 px; they must be at least 0.001"),
        ("images.txt", "set/001.png", "set/002.png", "has the image 'set/002.png' twice"),
    ],
)
def test_read_colmap_refuses_malformed_text_scene_with_line(tmp_path, file, old, new, reason):
    write_scene(tmp_path / "sparse", cameras(), text=True)
    path = tmp_path / "sparse" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(RecordingInvalid, match=reason):
        read_colmap(tmp_path)


def test_read_colmap_refuses_points_out_of_range(tmp_path):
    write_scene(tmp_path / "sparse", cameras(), text=True, points=[(1.0, 2.0, 1.1e9, 255, 0, 7)])
    with pytest.raises(RecordingInvalid, match=r"points3D.* beyond 1e\+09"):
        read_colmap(tmp_path).points()


@pytest.mark.parametrize("text", [True, False])
def test_read_colmap_refuses_truncated_points_file(tmp_path, text):
    write_scene(tmp_path / "sparse", cameras(), text=text, points=POINTS)
    path = tmp_path / "sparse" / f"points3D.{'txt' if text else 'bin'}"
    path.write_bytes(path.read_bytes()[:12])
    with pytest.raises(RecordingInvalid, match=r"points3D"):
        read_colmap(tmp_path).points()


@pytest.mark.parametrize("text", [True, False])
def test_read_colmap_of_damaged_bytes_raises_only_recording_error(tmp_path, text):
    write_scene(tmp_path / "sparse", cameras(), text=text, points=POINTS)
    generator = np.random.default_rng(0)
    refused = 0
    for path in sorted((tmp_path / "sparse").iterdir()):
        good = path.read_bytes()
        for _ in range(100):
            data = bytearray(good[: generator.integers(0, len(good) + 1)] if generator.random() < 0.3 else good)
            for at in generator.integers(0, len(data), generator.integers(1, 4)) if data else []:
                data[at] = generator.integers(256)
            path.write_bytes(data)
            try:
                read_colmap(tmp_path).points()
            except RecordingError as error:
                refused += 1
                assert str(tmp_path) in str(error)
        path.write_bytes(good)
    assert refused > 50
