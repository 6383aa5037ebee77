"""Depth of real pairs, with the same settings for all of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.depth.stereo import StereoDepth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame


@pytest.mark.recordings
def test_stereo_depth_of_scared_pair_matches_true_disparity(recordings_dir):
    folder = recordings_dir / "scared_pair"
    left, right = (cv2.imread(str(folder / f"{eye}.png"))[..., ::-1].copy() for eye in ("left", "right"))
    truth = cv2.imread(str(folder / "disparity.tiff"), cv2.IMREAD_UNCHANGED)
    camera = Camera.from_focal(1000, left.shape[1], left.shape[0])
    found = StereoDepth().estimate(Frame(0, 0, left, right_image=right, right_camera=camera.right_eye(4.0)), camera)
    seen = (truth > 0) & (found.confidence >= 0.5)
    error = np.abs(4000 / found.depth[seen] - truth[seen])
    assert error.mean() <= 0.40 and np.median(error) <= 0.27
    assert seen.sum() / (truth > 0).sum() >= 0.90
