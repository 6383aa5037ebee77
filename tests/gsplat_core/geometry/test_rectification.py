"""Pairs from distorted cameras that are turned against each other become rectified ones."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings.calibration import Rectification, StereoCalibration, Undistortion
from gsplat_core.scene.cameras import Camera

SIZE = (320, 256)
CALIBRATION = StereoCalibration(
    left_K=np.array([[300.0, 0, 150], [0, 302, 130], [0, 0, 1]]),
    left_distortion=np.array([-0.1, 0.05, 0.001, -0.002]),
    right_K=np.array([[305.0, 0, 170], [0, 304, 126], [0, 0, 1]]),
    right_distortion=np.array([-0.08, 0.02, 0.0, 0.001, 0.01]),
    rotation=cv2.Rodrigues(np.array([0.01, 0.03, -0.02]))[0],
    translation_mm=np.array([-4.0, 0.1, 0.2]),
    source="a test",
)


def seen(points, K, distortion, size=SIZE):
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]


def picture_of(points):
    """Dots where points are, wide enough to be found again with a fraction of a pixel."""
    y, x = np.indices(SIZE[::-1])
    dots = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8) for u, v in points)
    return np.clip(250 * dots, 0, 255).astype(np.uint8)


def found(picture):
    y, x = np.indices(picture.shape)
    weight = picture.astype(np.float64)
    return (weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()


@pytest.mark.parametrize("point", [(0.0, 0.0, 60.0), (15, -12, 70), (-14, 10, 50)])
def test_rectified_pictures_match_rectified_cameras(point):
    point = np.array([point], np.float64)
    rectification = Rectification(CALIBRATION, *SIZE)
    other = point @ CALIBRATION.rotation.T + CALIBRATION.translation_mm
    left = rectification.left(picture_of(seen(point, CALIBRATION.left_K, CALIBRATION.left_distortion)))
    right = rectification.right(picture_of(seen(other, CALIBRATION.right_K, CALIBRATION.right_distortion)))
    turned = rectification.turn[:3, :3] @ point[0]
    for picture, camera in ((left, rectification.left_camera), (right, rectification.right_camera)):
        x, y, z = camera.world_to_camera[:3, :3] @ turned + camera.world_to_camera[:3, 3]
        expected = camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]
        assert np.allclose(np.array(found(picture)) + 0.5, expected, atol=0.15)


def test_rectification_keeps_baseline():
    away = Rectification(CALIBRATION, *SIZE).right_camera.world_to_camera[:3, 3]
    assert np.allclose(away, [-np.linalg.norm(CALIBRATION.translation_mm), 0, 0])


def test_rectification_inside_marks_unseen_pixels():
    rectification = Rectification(CALIBRATION, *SIZE)
    white = rectification.left(np.full((256, 320, 3), 255, np.uint8))
    assert not rectification.inside.all()
    assert (white[rectification.inside == 0] < 255).mean() > 0.5
    assert set(np.unique(rectification.inside)) == {0, 1}


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"translation_mm": np.array([4.0, 0, 0])}, "swap the eyes"),
        ({"translation_mm": np.array([-1.0, 4, 0])}, "not to the right"),
        ({"translation_mm": np.zeros(3)}, "the eyes are 0 mm apart"),
        ({"translation_mm": np.array([-1.01e4, 0, 0])}, "the eyes are 10100 mm apart"),
        ({"translation_mm": np.array([-0.9e-3, 0, 0])}, r"the eyes are 0\.0009 mm apart"),
        ({"translation_mm": np.array([-np.inf, 0, 0])}, "the eyes are inf mm apart"),
        ({"translation_mm": np.array([-1.0, 0, -4])}, "not to the right"),
        ({"rotation": np.diag([1.0, 1, -1])}, "is not a rotation matrix"),
        ({"rotation": 1.01 * np.eye(3)}, "is not a rotation matrix"),
        ({"left_K": np.array([[300.0, 0, 2e6], [0, 300, 128], [0, 0, 1]])}, "the left eye's intrinsics"),
        ({"right_K": np.array([[300.0, 0, np.nan], [0, 300, 128], [0, 0, 1]])}, "the right eye's intrinsics"),
        ({"right_K": np.array([[300.0, 0, 160], [0, 0.9, 128], [0, 0, 1]])}, "the right eye's intrinsics"),
        ({"right_K": np.array([[300.0, 0, 160], [0, 1.0, 128], [0, 0, 1]])}, "the right eye's intrinsics"),
        ({"left_distortion": np.array([0, 0, -1001.0, 0])}, "the left eye's distortion"),
        ({"right_K": np.array([[300.0, 0, 160], [0, 300, 256], [0, 0, 1]])}, "the right eye's principal point"),
        ({"right_K": np.array([[300.0, 0, 160], [0, 300, 0], [0, 0, 1]])}, "the right eye's principal point"),
        ({"left_K": np.diag([0.0, 300, 1])}, "impossible for a camera"),
        ({"right_distortion": np.array([np.nan, 0, 0, 0])}, "impossible for a lens"),
        ({"size": (640, 512)}, "is for pictures of"),
        ({"left_K": np.array([[300.0, 0, 500], [0, 300, 128], [0, 0, 1]])}, "is outside its picture"),
    ],
)
def test_rectification_refuses_invalid_calibration(fields, sentence):
    with pytest.raises(InvalidInput, match=sentence):
        Rectification(replace(CALIBRATION, **fields), *SIZE)


@pytest.mark.parametrize(
    "fields",
    [
        {"translation_mm": np.array([-0.99e4, 0, 0])},
        {"translation_mm": np.array([-1.1e-3, 0, 0])},
        {"translation_mm": np.array([-4.0, 4, 0])},
        {"left_K": np.array([[300.0, 0, 0.9e6], [0, 300, 128], [0, 0, 1]])},
        {"left_K": np.array([[1.1, 0, 160], [0, 1.1, 128], [0, 0, 1]])},
        {"left_distortion": np.array([0, 0, -999.0, 0])},
        {"left_distortion": np.zeros(0)},
        {"rotation": (1 + 4e-4) * np.eye(3)},
    ],
)
def test_stereo_calibration_within_limits_is_accepted(fields):
    assert replace(CALIBRATION, **fields).wrong() is None


@pytest.mark.parametrize(("fold", "is_seen"), [(1.8, True), (1.4, False)])
def test_undistortion_requires_middle_of_sides_in_view(fold, is_seen):
    """The lens moves a radius r to r (1 - r² / (3 fold²)), which is 2/3 fold at most. The sides are at 1, the corners at 1.41."""
    camera, coefficients = Camera.from_focal(100.0, 200, 200), [-1 / (3 * fold**2), 0, 0, 0]
    if is_seen:
        assert Undistortion(camera, coefficients).camera.K[0, 0] < 100
    else:
        with pytest.raises(InvalidInput, match="folds the picture"):
            Undistortion(camera, coefficients)


def test_undistorted_picture_ends_at_middle_of_distorted_sides():
    """With a barrel distortion the middle of a side is the nearest part of it, so that nothing outside is shown."""
    camera, fold = Camera.from_focal(100.0, 240, 160), 2.5
    found = Undistortion(camera, [-1 / (3 * fold**2), 0, 0, 0]).camera
    for half, focal, centre, side in (
        (1.2, found.K[0, 0], found.K[0, 2], 240),
        (0.8, found.K[1, 1], found.K[1, 2], 160),
    ):
        radii = np.linspace(0, fold, 100_000)
        ideal = radii[np.argmax(radii * (1 - radii**2 / (3 * fold**2)) >= half)]
        assert (focal * ideal + centre, centre - focal * ideal) == pytest.approx((side, 0), abs=0.1)
