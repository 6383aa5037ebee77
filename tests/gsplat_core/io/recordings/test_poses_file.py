"""`poses.npy` next to a recording: written poses are read back, and invalid files are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.calibration import write_poses


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return synthesize(tmp_path / "r", frames=3, width_px=48, height_px=40, stereo=False, camera="moving")


def turned(count: int = 3) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(count):
        angle = 0.1 * index
        poses[index, :2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        poses[index, :3, 3] = [index, 2 * index, -index]
    return poses


def test_poses_file_overrides_recorded_poses(folder):
    before = open_recording(folder)
    write_poses(folder / "poses.npy", turned())
    recording = open_recording(folder)
    for index, frame in enumerate(recording):
        np.testing.assert_allclose(frame.pose, turned()[index], atol=1e-12)
        np.testing.assert_allclose(recording.camera_at(index).world_to_camera, turned()[index], atol=1e-12)
    assert np.array_equal(recording.camera.K, before.camera.K)
    assert recording.digest != before.digest


@pytest.mark.parametrize(
    ("poses", "said"),
    [
        (turned(2), "2 poses for 3 frames"),
        (turned()[:, :3], r"\[3, 3, 4\] in place of"),
        (np.where(np.eye(4) > 0, np.nan, turned()), "pose 0 is not one"),
        (turned() * 2, "pose 0 is not one"),
        (turned() * np.array([1, 1, -1, 1])[:, None], "not a rotation"),
    ],
)
def test_invalid_poses_file_is_refused(folder, poses, said):
    np.save(folder / "poses.npy", poses)
    with pytest.raises(RecordingInvalid, match=said):
        open_recording(folder)
