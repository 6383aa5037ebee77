"""Pictures of a known surface, seen by cameras whose poses are given."""

from __future__ import annotations

from functools import cache, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

WIDTH, HEIGHT, FOCAL = 160, 128, 140.0
FIRST = Camera.from_focal(FOCAL, WIDTH, HEIGHT)
NEAR, FAR = 1.4, 2.2
SIDEWAYS = (0.02, 0.0, 0.0)


@cache
def texture() -> NDArray[np.uint8]:
    noise = np.random.default_rng(3).uniform(0, 255, (HEIGHT + 80, WIDTH + 80, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    painted = np.asarray(np.clip((smooth - 127) * 6 + 127, 0, 255), np.uint8)
    painted.setflags(write=False)
    return painted


def depth_of_surface() -> NDArray[np.float32]:
    """[H, W]: near on the left, far on the right."""
    return np.tile(np.linspace(NEAR, FAR, WIDTH, dtype=np.float32), (HEIGHT, 1))


def camera_at(position: tuple[float, float, float]) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = -np.array(position)
    return FIRST.with_pose(pose)


def seen_from(position: tuple[float, float, float], depth: NDArray[np.float32], tissue_px: float = 0.0) -> Frame:
    """The surface, painted as FIRST sees it, from `position`; the tissue itself has moved to the right."""
    plane = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1) - [WIDTH / 2, HEIGHT / 2]
    picture = texture()[40 : 40 + HEIGHT, 40 : 40 + WIDTH]
    source = plane.copy()
    for _ in range(20):  # where FIRST sees what is at this pixel
        x, y = (source + [WIDTH / 2, HEIGHT / 2] - 0.5).astype(np.float32).transpose(2, 0, 1)
        z = cv2.remap(depth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[..., None]
        source = (plane * (z - position[2]) + FOCAL * np.array(position[:2])) / z - [tissue_px, 0]
    x, y = (source + [WIDTH / 2, HEIGHT / 2] - 0.5).astype(np.float32).transpose(2, 0, 1)
    return Frame(0, 0, np.asarray(cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)))


@lru_cache(256)
def _usual(position: tuple[float, float, float], tissue_px: float) -> Frame:
    """The usual surface. Many tests ask for the same pictures, and each takes 20 ms."""
    return seen_from(position, depth_of_surface(), tissue_px)


def video(
    count: int, step: tuple[float, float, float], depth: NDArray[np.float32] | None = None, tissue_px: float = 0.0
) -> tuple[list[Frame], list[Camera]]:
    positions = [tuple(number * value for value in step) for number in range(count)]
    if depth is None:
        kept = [_usual(each, number * tissue_px) for number, each in enumerate(positions)]  # type: ignore[arg-type]
        frames = [frame.with_fields(image=frame.image.copy()) for frame in kept]
    else:
        frames = [seen_from(each, depth, number * tissue_px) for number, each in enumerate(positions)]  # type: ignore[arg-type]
    return frames, [camera_at(each) for each in positions]  # type: ignore[arg-type]
