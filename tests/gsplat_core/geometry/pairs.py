"""Made-up pictures of two eyes whose disparity is known."""

from __future__ import annotations

import cv2
import numpy as np

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

WIDTH, HEIGHT = 320, 240
FOCAL_PX, BASELINE_MM = 300.0, 4.0


def texture(rng, height=HEIGHT, width=WIDTH):
    """Grey float32 [H, W] with detail of several sizes, as tissue has it."""
    layers = [cv2.GaussianBlur(rng.normal(0, 1, (height, width)), (0, 0), sigma) * sigma for sigma in (1.2, 3.0, 9.0)]
    return np.clip(120 + 45 * np.sum(layers, axis=0), 0, 245).astype(np.float32)


def bowl(low_px=20.0, high_px=34.0, height=HEIGHT, width=WIDTH):
    """A smooth disparity [H, W] of the left picture."""
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return (high_px - (high_px - low_px) * (x * x + y * y) / 2).astype(np.float32)


def right_of(left, disparity, lower_px=0.0):
    """The right eye's picture of a surface without edges, whose rows are lower by so much."""
    rows, columns = np.indices(left.shape[:2], dtype=np.float32)
    there = columns.copy()
    for _ in range(30):  # the column of the left picture that lands here
        there = columns + cv2.remap(
            disparity, there, rows - lower_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return cv2.remap(left, there, rows - np.float32(lower_px), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def as_rgb(grey):
    return np.repeat(np.clip(np.round(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def camera():
    return Camera.from_focal(FOCAL_PX, WIDTH, HEIGHT)


def frame(left, right, calibrated=True, seq=0, **fields):
    right_camera = camera().right_eye(BASELINE_MM) if calibrated else None
    return Frame(seq, seq * 33_000_000, as_rgb(left), right_image=as_rgb(right), right_camera=right_camera, **fields)
