"""Values that a frame refuses, and its statements about the right eye and depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame

IMAGE = np.zeros((4, 6, 3), np.uint8)


def test_frame_rejects_right_camera_of_different_size():
    with pytest.raises(InvalidInput, match="right camera is 8x4, the image 6x4"):
        Frame(0, 0, IMAGE, right_camera=Camera.from_focal(5, 8, 4))


def test_frame_rejects_confidence_of_different_size():
    with pytest.raises(InvalidInput, match=r"depth_confidence is \[4, 5\]"):
        Frame(0, 0, IMAGE, depth_confidence=np.ones((4, 5), np.float32))


@pytest.mark.parametrize("baseline", [0.0, -1.0, float("nan"), float("inf")])
def test_right_eye_rejects_invalid_baseline(baseline):
    with pytest.raises(InvalidInput, match="between the eyes"):
        Camera.from_focal(5, 8, 4).right_eye(baseline)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_right_camera_projection_matches_disparity(tmp_path: Path, scale):
    folder = synthesize(tmp_path / "pair", frames=1, width_px=96, height_px=80, stereo=True)
    recording = open_recording(folder, scale=scale)
    frame = next(iter(recording))
    assert frame.depth_origin is DEPTH_ORIGINS["measured"] and frame.depth is not None
    right, K, baseline = frame.right_camera, recording.camera.K, recording.stereo_baseline_mm
    assert right is not None and (right.width_px, right.height_px) == (frame.width_px, frame.height_px)
    z = float(frame.depth[10, 20])
    point = np.linalg.solve(K, [20.5, 10.5, 1.0]) * z
    seen = right.K @ (right.world_to_camera[:3, :3] @ point + right.world_to_camera[:3, 3])
    assert seen[:2] / seen[2] == pytest.approx([20.5 - K[0, 0] * baseline / z, 10.5])
