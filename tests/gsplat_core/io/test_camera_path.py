"""Camera paths: where they are between their cameras, and which files are refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from gsplat_core import Camera
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.camera_path import CameraPath, Waypoint, read_camera_path

CAMERA = Camera.from_focal(40.0, 32, 24)


def turned(degrees: float, place=(0.0, 0.0, 0.0)) -> np.ndarray:
    angle = math.radians(degrees)
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    pose[:3, 3] = place
    return pose


def test_camera_path_interpolates_rotation_and_position():
    path = CameraPath([Waypoint(1.0, turned(-20)), Waypoint(3.0, turned(60, (8.0, 0, 4.0)))])
    assert path.window_s == (1.0, 3.0)
    for time_s, degrees, place in [(1, -20, (0, 0, 0)), (1.5, 0, (2, 0, 1)), (2, 20, (4, 0, 2)), (3, 60, (8, 0, 4))]:
        camera = path.camera(CAMERA, time_s)
        assert np.allclose(camera.world_to_camera @ turned(degrees, place), np.eye(4), atol=1e-9)
        assert np.allclose(camera.position, place, atol=1e-9) and np.array_equal(camera.K, CAMERA.K)
    for outside, inside in [(-5, 1), (9, 3)]:
        assert np.allclose(path.camera(CAMERA, outside).position, path.camera(CAMERA, inside).position)


def test_camera_path_half_turn_interpolates_valid_rotations():
    path = CameraPath([Waypoint(0.0, turned(0)), Waypoint(1.0, turned(180))])
    for time_s in np.linspace(0, 1, 11):
        rotation = path.camera(CAMERA, time_s).world_to_camera[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1)


def test_camera_path_of_one_camera_is_constant_and_intrinsics_interpolate():
    still = CameraPath([Waypoint(2.0, turned(10))])
    assert still.window_s == (2.0, 2.0) and np.allclose(still.camera(CAMERA, 7).world_to_camera @ turned(10), np.eye(4))
    zoom = CameraPath([Waypoint(0, turned(0), (40, 40, 16, 12)), Waypoint(1, turned(0), (80, 60, 14, 12))])
    assert zoom.camera(CAMERA, 0.5).K.tolist() == [[60, 0, 15], [0, 50, 12], [0, 0, 1]]


def write(tmp_path, cameras):
    file = tmp_path / "path.json"
    file.write_text(cameras if isinstance(cameras, str) else json.dumps({"cameras": cameras}))
    return file


def camera(time_s=0.0, pose=None, **more):
    return {"time_s": time_s, "camera_to_world": (np.eye(4) if pose is None else pose).tolist(), **more}


def test_read_camera_path_of_json_file(tmp_path):
    intrinsics = {"fx": 30, "fy": 31.5, "cx": 15, "cy": 11}
    path = read_camera_path(write(tmp_path, [camera(0.5, intrinsics=intrinsics), camera(2, intrinsics=intrinsics)]))
    assert path.window_s == (0.5, 2.0) and path.camera(CAMERA, 1).K[1, 1] == pytest.approx(31.5)


@pytest.mark.parametrize(
    ("cameras", "said"),
    [
        ("{", "not valid JSON"),
        ("3", "must be a JSON object"),
        ("[]", "must have 1 to"),
        ("{}", "cameras must be a list"),
        ([], "cameras must be a list"),
        ([3], r"cameras\[0\] must be a JSON object"),
        ([{"time_s": 0}], "camera_to_world must be 4 rows"),
        ([camera(float("nan"))], "NaN is not a number"),
        ([camera(pose=np.diag([2.0, 2, 2, 1]))], "its rotation is off by 3"),
        ([camera(pose=np.diag([1.0, 1, -1, 1]))], "it mirrors"),
        ([camera(pose=np.diag([1.0, 1, 1, 2]))], "its last row is 0 0 0 2"),
        ([camera(1), camera(1)], "times of a camera path must increase"),
        ([camera(0), camera(1, intrinsics={"fx": 1, "fy": 1, "cx": 0, "cy": 0})], "with every camera or with none"),
        ([camera(intrinsics={"fx": 0, "fy": 1, "cx": 0, "cy": 0})], "fx must be"),
    ],
)
def test_read_camera_path_refuses_invalid_content(tmp_path, cameras, said):
    with pytest.raises(InvalidSetting, match=said):
        read_camera_path(write(tmp_path, cameras))


def test_camera_path_refuses_missing_file_and_no_cameras(tmp_path):
    with pytest.raises(InvalidSetting, match=r"cannot read the camera path .*No such file"):
        read_camera_path(tmp_path / "none.json")
    with pytest.raises(InvalidInput, match="at least one"):
        CameraPath([])


def inria(k, pose, **changed):
    """Entry of the cameras.json of the INRIA trainer."""
    entry = {"id": k, "img_name": f"{k:05d}", "width": 64, "height": 48, "fx": 80.0, "fy": 60.0}
    return {**entry, "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(), **changed}


def test_inria_cameras_are_one_second_apart(tmp_path):
    poses = [turned(10.0 * k, (k, 2.0, 3.0)) for k in range(3)]
    path = read_camera_path(write(tmp_path, json.dumps([inria(k, pose) for k, pose in enumerate(poses)])))
    assert path.window_s == (0.0, 2.0)
    for k, pose in enumerate(poses):
        assert np.allclose(path.camera(CAMERA, k).world_to_camera @ pose, np.eye(4), atol=1e-9)
    # Half the height: half the focal lengths, and the principal point in the middle.
    assert path.camera(CAMERA, 1.0).K.tolist() == [[40, 0, 16], [0, 30, 12], [0, 0, 1]]


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        (inria(0, turned(0), position=[1, 2]), "position"),
        (inria(0, turned(0), rotation=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "rotation must be a rotation"),
        (inria(0, turned(0), height=0), "height"),
        (inria(0, turned(0), fx=-1), "fx"),
        ("camera", "JSON object"),
    ],
)
def test_invalid_inria_camera_is_refused(tmp_path, entry, reason):
    with pytest.raises(InvalidSetting, match=reason):
        read_camera_path(write(tmp_path, json.dumps([inria(0, turned(0)), entry])))


@pytest.mark.parametrize("text", ["[1", '[{}], "cameras": []'])
def test_read_camera_path_refuses_broken_json_list(tmp_path, text):
    with pytest.raises(InvalidSetting):
        read_camera_path(write(tmp_path, text))
