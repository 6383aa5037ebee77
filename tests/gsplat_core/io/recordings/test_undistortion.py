"""Recordings of a distorted lens are read as those of the same camera without distortion."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidInput, RecordingInvalid
from gsplat_core.io.recordings import open_recording, validate_recording
from gsplat_core.io.recordings.calibration import Undistortion
from gsplat_core.scene.cameras import Camera

W, H = 96, 80
FX, FY, CX, CY = 80.0, 78.0, 46.0, 41.5
LENSES = {"pinhole": [-0.28, 0.09, 2e-3, -1e-3, -0.01], "fisheye": [-0.05, 0.02, -0.004, 0.001]}
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])


def pattern(directions: np.ndarray) -> np.ndarray:
    """Return smooth colours [..., 3] and a depth [...] of directions [..., 3]."""
    x, y = directions[..., 0], directions[..., 1]
    colours = [np.sin(5 * x + 1), np.cos(6 * y), np.sin(4 * (x - y))]
    return np.stack([127 + 100 * each for each in colours], -1).round().astype(np.uint8)


def directions_of(pixels: np.ndarray, camera: Camera, distortion: list[float]) -> np.ndarray:
    """Return unit directions [..., 3] by OpenCV, which counts from the first pixel's centre."""
    matrix = camera.K.copy()
    matrix[:2, 2] -= 0.5
    flat = (pixels - 0.5).reshape(1, -1, 2)
    if camera.model == "fisheye":
        points = cv2.fisheye.undistortPoints(flat, matrix, np.array(distortion or [0.0] * 4))
    else:
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-12)
        points = cv2.undistortPoints(flat, matrix, np.array(distortion), criteria=criteria)
    points = points.reshape(*pixels.shape[:-1], 2)
    directions = np.concatenate([points, np.ones_like(points[..., :1])], -1)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def grid() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5), -1)


def write_recording(folder: Path, model: str, make: SimpleNamespace, changes: dict[str, object] | None = None) -> Path:
    image = pattern(directions_of(grid(), Camera(K, W, H, model=model), LENSES[model]))
    for index in range(2):
        make.image(folder / "images" / f"{index}.png", image)
        make.image(folder / "masks" / f"{index}.png", np.where(grid()[..., 0] > 80, 255, 0).astype(np.uint8))
        make.image(folder / "depth" / f"{index}.png", np.full((H, W), 40, np.uint8))
    frames = [{"file": f"images/{index}.png", "camera_to_world": np.eye(4).tolist()} for index in range(2)]
    content = {"width": W, "height": H, "fx": FX, "fy": FY, "cx": CX, "cy": CY, "model": model, "fps": 30}
    content |= {"distortion": LENSES[model], "frames": frames} | (changes or {})
    (folder / "cameras.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_frames_match_ideal_camera(tmp_path: Path, make: SimpleNamespace, model: str) -> None:
    recording = open_recording(write_recording(tmp_path, model, make))
    frame = next(iter(recording))
    camera = recording.camera
    assert camera.model == model and not np.allclose(camera.K, K)
    directions = directions_of(grid(), camera, [])
    difference = frame.image.astype(int) - pattern(directions)
    assert np.abs(difference[2:-2, 2:-2]).max() <= 4
    # Mask and depth follow the picture; the same direction was masked.
    source = cv2.projectPoints if model == "pinhole" else cv2.fisheye.projectPoints
    places = source(directions.reshape(1, -1, 3), np.zeros(3), np.zeros(3), K, np.array(LENSES[model]))[0]
    tool = places.reshape(H, W, 2)[..., 0] > 80
    assert frame.mask is not None and frame.depth is not None
    assert (frame.mask == ~tool).mean() > 0.99 and 0 < tool.mean() < 0.3
    assert (frame.depth == 40).all() and frame.loss_mask is None
    assert validate_recording(tmp_path).ok


def test_distortion_in_recording_json_is_applied(tmp_path: Path, make: SimpleNamespace) -> None:
    write_recording(tmp_path, "pinhole", make)
    expected = next(iter(open_recording(tmp_path))).image
    content = json.loads((tmp_path / "cameras.json").read_text())
    camera = {key: content[key] for key in ("width", "height", "fx", "fy", "cx", "cy", "distortion")}
    described = {"format": "intrasplat-recording", "version": 1, "fps": 30, "camera": camera}
    (tmp_path / "cameras.json").unlink()
    (tmp_path / "recording.json").write_text(json.dumps(described))
    assert np.array_equal(next(iter(open_recording(tmp_path))).image, expected)


def test_valid_mask_is_undistorted_once(tmp_path: Path, make: SimpleNamespace) -> None:
    write_recording(tmp_path, "pinhole", make)
    make.image(tmp_path / "valid_mask.png", np.where(grid()[..., 0] < 80, 255, 0).astype(np.uint8))
    with_valid = next(iter(open_recording(tmp_path))).mask
    (tmp_path / "valid_mask.png").unlink()
    assert with_valid is not None
    assert np.array_equal(with_valid, next(iter(open_recording(tmp_path))).mask)  # the tool masks have the same border


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"distortion": [0.1, 0.2]}, "distortion is [0.1, 0.2]"),
        ({"distortion": [0.1, 0.2, 0.3, "x"]}, "Give OpenCV's coefficients"),
        ({"distortion": [1e9, 0, 0, 0]}, "distortion is"),
        ({"distortion": [0.1] * 4, "model": "ortho"}, "none of an ortho camera"),
        ({"distortion": [-2.0, 0, 0, 0]}, "folds the picture"),
    ],
)  # fmt: skip
def test_impossible_distortion_is_refused(
    tmp_path: Path, make: SimpleNamespace, refused: Callable[..., str], changes: dict[str, object], words: str
) -> None:
    refused(write_recording(tmp_path, "pinhole", make, changes), RecordingInvalid, "cameras.json", words)


def test_distortion_with_right_images_requires_stereo_calibration(
    tmp_path: Path, make: SimpleNamespace, refused: Callable[..., str]
) -> None:
    write_recording(tmp_path, "pinhole", make)
    for index in range(2):
        make.image(tmp_path / "images_right" / f"{index}.png", np.zeros((H, W, 3), np.uint8))
    refused(tmp_path, RecordingInvalid, "distortion of one eye", "stereo calibration file")


def test_undistortion_has_no_mask_for_full_picture_and_refuses_ortho() -> None:
    assert Undistortion(Camera(K, W, H), LENSES["pinhole"]).inside is None
    with pytest.raises(InvalidInput, match="ortho has no distortion"):
        Undistortion(Camera(K, W, H, model="ortho"), [0.1] * 4)
