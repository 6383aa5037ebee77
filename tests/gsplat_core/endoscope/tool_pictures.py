"""Drawn tissue, with an instrument and with a round view."""

from __future__ import annotations

import cv2
import numpy as np


def tissue(height, width):
    noise = cv2.resize(np.random.default_rng(0).normal(0, 1, (9, 11)), (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.array([170.0, 70.0, 60.0]) * (1 + 0.12 * noise[..., None]), 0, 255).astype(np.uint8)


def with_rod(height, width):
    """A grey rod with a bright line from the right border to the middle, and its mask (1 = rod)."""
    image, mask = tissue(height, width), np.zeros((height, width), np.uint8)
    y, x = np.mgrid[0:height, 0:width] / height
    across = (y - 0.25 - 0.25 * x / (width / height)) / 0.12
    rod = (np.abs(across) < 1) & (x > 0.5 * width / height)
    shade = 40 + 120 * np.sqrt(np.clip(1 - across**2, 0, 1)) + 90 * np.exp(-(((across + 0.3) / 0.2) ** 2))
    image[rod] = np.clip(shade[rod][:, None], 0, 255)
    mask[rod] = 1
    return image, mask


def in_round_view(image):
    """The picture with a black surround, and its view (1 inside)."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width]
    inside = (x - width / 2) ** 2 + (y - height / 2) ** 2 < (0.55 * height) ** 2
    return image * inside[..., None].astype(np.uint8), inside
