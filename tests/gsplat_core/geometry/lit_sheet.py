"""A textured sheet of tissue in the light of a lamp at the camera, which moves; with exact depth."""

from __future__ import annotations

import cv2
import numpy as np

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

WIDTH, HEIGHT, FOCAL = 160, 128, 140.0
CAMERA = Camera.from_focal(FOCAL, WIDTH, HEIGHT)
PINK = np.array([0.6, 0.2, 0.15])
LIGHT = 0.6
"""Dim: no camera bends what is dark."""


def rays():
    """x / z and y / z of the pixels' middles."""
    column, row = np.arange(WIDTH) + 0.5 - CAMERA.K[0, 2], np.arange(HEIGHT) + 0.5 - CAMERA.K[1, 2]
    return np.meshgrid(column / FOCAL, row / FOCAL)


def facing_and_distance(z):
    """Cosine of the angle between normal and ray, and the distance, of a surface of depth z [H, W]."""
    x, y = rays()
    points = np.stack([x * z, y * z, z], axis=-1)
    by_row, by_column = np.gradient(points, axis=(0, 1))
    normal = np.cross(by_column, by_row)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    distance = np.linalg.norm(points, axis=-1)
    return np.abs(np.einsum("hwi,hwi->hw", normal, points)) / distance, distance


def noise(seed, cell_px):
    """Smooth noise [H, W]."""
    grid = np.random.default_rng(seed).standard_normal((HEIGHT // cell_px + 2, WIDTH // cell_px + 2)).astype(np.float32)
    return cv2.resize(grid, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def pigment(seed=3, cell_px=6):
    """Return the reflectance of the tissue per channel [H, W, 3]."""
    return PINK * np.exp(-np.maximum(noise(seed, cell_px), 0)[..., None] * np.array([0.3, 0.9, 0.8]))


def frame(number, z, colours, glints=None, every_s=0.4, **fields):
    """A picture of depth z [H, W]; glints: [H, W], where true a white reflection is added."""
    facing, distance = facing_and_distance(z)
    linear = LIGHT * (facing * (60 / distance) ** 2)[..., None] * colours
    if glints is not None:
        linear = linear + glints[..., None] * 0.3
    linear = np.clip(linear, 0, 0.9)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return Frame(number, round(number * every_s * 1e9), np.round(255 * curve).astype(np.uint8), **fields)


def error(found, true):
    """Root mean square after one factor, by the median depth."""
    scaled = found * np.median(true / found)
    return float(np.sqrt(np.mean((scaled - true) ** 2)) / np.median(true))
