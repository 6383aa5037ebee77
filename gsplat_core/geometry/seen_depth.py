"""Depth of single points from the frame's own depth map or its stereo pair."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.depth_map import BELIEVED
from gsplat_core.geometry.point_flow import Points, followed
from gsplat_core.geometry.stream_tracks import LEVELS, PATCH_PX, SmallPicture
from gsplat_core.scene.frames import Frame

RETURN_PX, ROWS_PX = 0.5, 1.5
"""Largest accepted forward-backward error and row difference of a point tracked to the right eye,
in pixels.
"""
LEAST_DISPARITY_PX = 0.5


def seen_depth(frame: Frame, picture: SmallPicture, pixels: Points) -> NDArray[np.float64]:
    """Return z [N] of points in a frame's reduced picture, 0 where unknown.

    Args:
        frame: frame with depth or a right eye.
        picture: reduced picture of the frame.
        pixels: positions in the reduced picture [N, 2].
    """
    if frame.depth is not None:
        return _of_map(frame, picture, pixels)
    if frame.right_image is not None and frame.right_camera is not None:
        return _of_eyes(frame, picture, pixels)
    return np.zeros(len(pixels))


def _of_map(frame: Frame, picture: SmallPicture, pixels: Points) -> NDArray[np.float64]:
    assert frame.depth is not None
    scale = np.array([frame.width_px / picture.grey.shape[1], frame.height_px / picture.grey.shape[0]])
    column, row = ((pixels + 0.5) * scale).astype(np.int64).T
    column, row = np.clip(column, 0, frame.width_px - 1), np.clip(row, 0, frame.height_px - 1)
    depth = frame.depth[row, column].astype(np.float64)
    sure = frame.depth_confidence is None or frame.depth_confidence[row, column] >= BELIEVED
    return np.where(sure & np.isfinite(depth) & (depth > 0), depth, 0.0)


def _of_eyes(frame: Frame, picture: SmallPicture, pixels: Points) -> NDArray[np.float64]:
    assert frame.right_image is not None and frame.right_camera is not None
    size = picture.grey.shape[1], picture.grey.shape[0]
    right = np.asarray(
        cv2.cvtColor(cv2.resize(frame.right_image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    )
    there, misses_px = followed(picture.grey, right.astype(np.uint8), pixels, window_px=PATCH_PX, levels=LEVELS)
    disparity, off_row = (pixels - there).T.astype(np.float64)
    baseline = -float(frame.right_camera.world_to_camera[0, 3])
    good = (misses_px < RETURN_PX) & (np.abs(off_row) < ROWS_PX) & (disparity > LEAST_DISPARITY_PX)
    return np.where(good, float(picture.camera.K[0, 0]) * baseline / np.where(good, disparity, 1.0), 0.0)
