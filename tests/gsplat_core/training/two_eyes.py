"""A textured, wavy surface before a stereo scope, rendered: what each of three cameras sees is known exactly."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.initialisation import gaussians_from_frame

WIDTH, HEIGHT, MARGIN = 64, 48, 16
LEFT = Camera.from_focal(60.0, WIDTH, HEIGHT)
BASELINE_MM = 5.0
RIGHT = LEFT.right_eye(BASELINE_MM)
THIRD = LEFT.with_pose([[1, 0, 0, 8.0], [0, 1, 0, 6.0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Camera to the left and above; not an eye of the scope."""


def true_depth(width: int, height: int) -> np.ndarray:
    """z of the surface in front of a camera [H, W]: waves of 8 mm about 56 mm."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return np.asarray(56 + 8 * np.sin(x / 11) * np.cos(y / 9), np.float32)


@cache
def surface() -> Gaussians:
    """Return the Gaussians of the scene, which extends beyond the fields of view of both cameras."""
    width, height = WIDTH + 2 * MARGIN, HEIGHT + 2 * MARGIN
    wide = Camera.from_focal(60.0, width, height)
    random = np.random.default_rng(3)
    image = random.integers(30, 226, (height // 4, width // 4, 3)).astype(np.uint8).repeat(4, 0).repeat(4, 1)
    frame = Frame(0, 0, image, depth=true_depth(width, height))
    return gaussians_from_frame(frame, wide, width * height // 3, sh_degree=0, default_depth_mm=56.0)


@cache
def _true(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    return seen(camera, surface())


def seen(camera: Camera, scene: Gaussians | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The picture, RGB uint8 [H, W, 3], and the depth [H, W]; without a scene, of what there is."""
    if scene is None:
        return _true(camera)
    with torch.no_grad():
        output = render(scene, camera)
    return (output.image.clamp(0, 1) * 255).round().to(torch.uint8).numpy(), output.depth.numpy()


def stereo_frame(seq: int = 0, *, with_depth: bool = False, **fields: object) -> Frame:
    """Both eyes at frame `seq` of a still scene."""
    left, depth = seen(LEFT)
    if with_depth:
        fields = {"depth": depth, "depth_origin": DEPTH_ORIGINS["measured"]} | fields
    return Frame(seq, seq * 33_000_000, left, **({"right_image": seen(RIGHT)[0], "right_camera": RIGHT} | fields))  # type: ignore[arg-type]
