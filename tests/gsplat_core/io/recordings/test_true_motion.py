"""Files of true motion: read at the size of the frame, or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.truth import open_motion
from gsplat_core.scene.frames import Frame


def written(folder: Path, flow: np.ndarray, scene_flow: np.ndarray | None = None) -> Path:
    for name, planes in (("flow", flow), ("scene_flow", scene_flow)):
        if planes is not None:
            (folder / name).mkdir()
            for index, plane in enumerate(planes):
                np.save(folder / name / f"{index:06d}.npy", plane)
    return folder


def frame(seq: int, width: int, height: int) -> Frame:
    return Frame(seq=seq, pts_ns=0, image=np.zeros((height, width, 3), np.uint8))


def test_flow_is_scaled_to_frame_size(tmp_path):
    flow = np.full((2, 20, 30, 2), (6.0, -4.0), np.float32)
    flow[0, 10:, 15:] = np.nan
    motion = open_motion(written(tmp_path, flow, np.full((2, 20, 30, 3), 5.0)), 3)
    half = motion.of(frame(0, 15, 10))
    assert half.flow.shape == (10, 15, 2) and half.flow.dtype == np.float32
    np.testing.assert_array_equal(half.flow[0, 0], (3, -2))
    assert np.isnan(half.flow[5:, 8:]).all() and np.isfinite(half.flow[:5]).all()
    assert (half.scene_flow == 5).all()  # lengths of the world are what they are
    np.testing.assert_array_equal(motion.of(frame(1, 30, 20)).flow, flow[1])
    assert motion.of(frame(2, 30, 20)) is None  # nothing leads on from the last frame


def test_missing_flow_or_scene_flow_is_none(tmp_path):
    assert open_motion(tmp_path, 3) is None
    motion = open_motion(written(tmp_path, np.zeros((3, 8, 8, 2))), 3)
    assert motion.of(frame(0, 8, 8)).scene_flow is None


@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3), (30, 20, 2), (0, 30, 2), (20, 20, 2)])
def test_flow_file_of_wrong_shape_is_refused(tmp_path, shape):
    motion = open_motion(written(tmp_path, np.zeros((1, *shape), np.float32)), 2)
    with pytest.raises(RecordingInvalid, match=r"000000\.npy"):
        motion.of(frame(0, 30, 20))


def test_too_few_flow_files_are_refused(tmp_path):
    with pytest.raises(RecordingInvalid, match="2 files for 4 frames"):
        open_motion(written(tmp_path, np.zeros((2, 8, 8, 2))), 4)
