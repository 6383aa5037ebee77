"""What the recorder writes, `open_recording` reads back."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.io.recordings import open_recording
from operators.errors import StorageFull
from operators.recorder import RecorderOp
from operators.storage import StorageReserve


def test_frames_masks_depth_and_poses_come_back(tmp_path, frame, camera, compute):
    rng = np.random.default_rng(0)
    frames = []
    for k in range(3):
        pose = np.eye(4)
        pose[0, 3] = 2.0 * k
        mask = np.ones((16, 24), np.uint8)
        mask[:4, : 3 + k] = 0
        depth = rng.uniform(20, 90, (16, 24)).astype(np.float32)
        frames.append(frame(k, pose=pose, mask=mask, depth=depth, right_image=frame(k + 1).image))
    operator = RecorderOp(None, folder=tmp_path / "take", camera=camera, fps=25.0)
    operator.start()
    for one in frames:
        compute(operator, frame=one)
    operator.stop()

    recording = open_recording(tmp_path / "take")
    assert (recording.frame_count, recording.fps) == (3, 25.0)
    np.testing.assert_allclose(recording.camera.K, camera.K)
    for read, written in zip(recording, frames, strict=True):
        assert read.pts_ns == written.pts_ns
        for field in ("image", "right_image", "mask", "depth"):
            np.testing.assert_array_equal(getattr(read, field), getattr(written, field), err_msg=field)
        np.testing.assert_allclose(read.pose, written.pose, atol=1e-12)


def test_after_a_crash_the_images_still_open(tmp_path, frame, camera, compute):
    operator = RecorderOp(None, folder=tmp_path / "take", camera=camera, fps=25.0)
    operator.start()
    for k in range(2):
        compute(operator, frame=frame(k))
    assert open_recording(tmp_path / "take").frame_count == 2


def test_a_full_disk_is_said_and_leaves_whole_files(tmp_path, frame, camera, compute):
    reserve_bytes = 0
    reserve = StorageReserve(tmp_path, lambda: reserve_bytes)
    operator = RecorderOp(None, folder=tmp_path / "take", camera=camera, fps=25.0, reserve=reserve)
    operator.start()
    compute(operator, frame=frame(0))
    reserve_bytes = 1 << 60
    with pytest.raises(StorageFull):
        compute(operator, frame=frame(1))
    operator.stop()
    assert open_recording(tmp_path / "take").frame_count == 1
