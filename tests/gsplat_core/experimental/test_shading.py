"""Separation of a picture into illumination, pigment and highlights."""

from __future__ import annotations

import cv2
import numpy as np

from gsplat_core.experimental.shading import SmallPicture, shading_in
from gsplat_core.scene.frames import Frame


def test_glints_are_counted_where_they_are_and_nowhere_else() -> None:
    """Small white dots on red tissue, on one side of the picture."""
    image = np.full((256, 320, 3), (150, 70, 60), np.uint8)
    dots = np.zeros((256, 320), np.uint8)
    for x in range(20, 150, 16):
        for y in range(20, 240, 16):
            cv2.circle(dots, (x, y), 2, 1, -1)
    image[dots > 0] = 255
    found = shading_in(SmallPicture.of(Frame(0, 0, image)))
    left, right = found.glints[:, :19], found.glints[:, 21:]
    assert right.max() == 0
    assert 0.7 < left.sum() * 64 / np.count_nonzero(dots) < 1.3, "cells are 8 pixels wide"
    assert (found.wet_share > 0.9).all()
