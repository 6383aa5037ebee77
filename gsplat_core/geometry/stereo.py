"""Depth from the two eyes of a stereo scope, by semi-global matching."""

from __future__ import annotations

import cv2
import numpy as np

from gsplat_core.geometry.depth_map import DepthMap
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame


class StereoDepth:
    """Estimates the depth of rectified pairs; without the right eye's camera it is relative, in units of the distance between the eyes."""

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """See `Estimator`."""
        if frame.right_image is None:
            return None
        left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (frame.image, frame.right_image))
        matcher = cv2.StereoSGBM.create(0, 128, 5, 8 * 25, 32 * 25, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH)
        disparity = matcher.compute(left, right).astype(np.float32) / 16
        baseline = 1.0 if frame.right_camera is None else -float(frame.right_camera.world_to_camera[0, 3])
        known = disparity > 0
        depth = np.where(known, float(camera.K[0, 0]) * baseline / np.where(known, disparity, 1), 0).astype(np.float32)
        return DepthMap(depth, known.astype(np.float32), DepthOrigin.STEREO, frame.right_camera is not None)
