"""Cameras: checks, scaling and identity."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import torch

from gsplat_core import Camera, InvalidInput

K = np.array([[500.0, 0, 310], [0, 510, 250], [0, 0, 1]])


def test_camera_tensors_and_defaults():
    camera = Camera(K, 640, 480)
    assert camera.model == "pinhole"
    torch.testing.assert_close(camera.viewmat, torch.eye(4))
    torch.testing.assert_close(camera.intrinsics, torch.tensor(K, dtype=torch.float32))


def test_camera_is_immutable():
    given = K.copy()
    camera = Camera(given, 640, 480)
    given[0, 0] = 1
    assert camera.K[0, 0] == 500
    with pytest.raises(ValueError, match="read-only"):
        camera.K[0, 0] = 1
    with pytest.raises(FrozenInstanceError):
        camera.width_px = 3  # type: ignore[misc]


def test_camera_scaling_keeps_rays():
    camera = Camera(K, 641, 480)
    half = camera.scaled(0.5)
    assert (half.width_px, half.height_px) == (320, 240)
    # The image's border is the same ray at both sizes, though 641 px do not halve evenly.
    assert (641 - camera.K[0, 2]) / camera.K[0, 0] == pytest.approx((320 - half.K[0, 2]) / half.K[0, 0])
    assert camera.K[1, 2] / camera.K[1, 1] == pytest.approx(half.K[1, 2] / half.K[1, 1])
    assert camera.scaled(1e-9).width_px == 1


def test_camera_position_from_pose():
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [1, 2, 3]
    camera = Camera(K, 640, 480).with_pose(pose)
    np.testing.assert_allclose(pose @ [*camera.position, 1], [0, 0, 0, 1], atol=1e-12)


def test_camera_equality_and_hash():
    camera = Camera(K, 640, 480)
    assert camera == Camera(K.tolist(), 640, 480) and hash(camera) == hash(Camera(K, 640, 480))
    zero = np.eye(4)
    zero[0, 3] = -0.0
    assert camera == camera.with_pose(zero)
    assert camera != Camera(K, 640, 481) and camera != Camera(K, 640, 480, model="fisheye") and camera != 3


def test_camera_rejects_invalid_arguments():
    skewed, mirrored, nan, affine = K.copy(), K.copy(), K.copy(), np.eye(4)
    skewed[0, 1], mirrored[1, 1], nan[0, 2], affine[3, 0] = 1, -510, math.nan, 1
    for arguments, message in [
        ((np.eye(4), 640, 480), r"K must be \[3, 3\], got \[4, 4\]"),
        ((K, 640, 480, np.eye(3)), r"world_to_camera must be \[4, 4\]"),
        ((skewed, 640, 480), "no skew"),
        ((mirrored, 640, 480), "-510"),
        ((nan, 640, 480), "not finite"),
        ((K, 640, 480, affine), "last row"),
        ((K, 0, 480), "0x480"),
        ((K, 640, 480, np.eye(4), "mirror"), "'mirror'.*pinhole"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            Camera(*arguments)
    with pytest.raises(InvalidInput, match="positive, got 0"):
        Camera(K, 640, 480).scaled(0)
