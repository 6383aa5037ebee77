"""Video to inject faults into: real recordings, and textures that move where none are needed."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import count, islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings import open_recording

Image = NDArray[np.uint8]
PLACES = {"cutting": "cutting", "heart": "heart/left.mp4", "sinus": "sinus", "colon": "colon/video.mp4"}
OTHERS = {name: f"others/{name}" for name in ("resting_bowel", "laparoscopy", "stereomis_like")}
"""Recordings that are no ordinary ones throughout: with cuts, blur and many tools."""
FRAME_NS = 33_333_333


@lru_cache(maxsize=4)
def clip(recordings_dir: Path, name: str) -> tuple[Image, ...]:
    """The pictures of a recording, at their own size; not to be written to."""
    return tuple(frame.image for frame in open_recording(recordings_dir / (PLACES | OTHERS)[name]))


def texture(seed: int, number: int, width: int = 160, height: int = 128) -> tuple[Image, ...]:
    """Reddish tissue with structure at several scales, which sways by a few pixels and never repeats; not to be written to."""
    made, further = _textures(seed, width, height)
    made.extend(islice(further, max(0, number - len(made))))
    return tuple(made[:number])


@lru_cache(maxsize=12)
def _textures(seed: int, width: int, height: int) -> tuple[list[Image], Iterator[Image]]:
    """Pictures of `texture` that were made, and those that follow them."""
    return [], _further(seed, width, height)


def _further(seed: int, width: int, height: int) -> Iterator[Image]:
    rng = np.random.default_rng(seed)
    large = np.zeros((height + 32, width + 32), np.float32)
    for size in (3, 8, 20):
        coarse = rng.normal(size=((height + 32) // size + 2, (width + 32) // size + 2)).astype(np.float32)
        large += cv2.resize(coarse, large.shape[::-1], interpolation=cv2.INTER_CUBIC) * size**0.5
    large = 110 + 28 * (large - large.mean()) / large.std()
    tint = np.array([1.3, 0.75, 0.7]) * (1 + 0.1 * rng.normal(size=3))
    for k in count():
        shift = np.array([[1, 0, -16 + 4 * np.sin(0.21 * k)], [0, 1, -16 + 3 * np.cos(0.17 * k)]], np.float32)
        grey = cv2.warpAffine(large, shift, (width, height), flags=cv2.INTER_LINEAR)
        grain = rng.normal(0, 1.5, (height, width, 3))
        picture = np.clip(grey[..., None] * tint + grain, 0, 255).astype(np.uint8)
        picture.setflags(write=False)
        yield picture


def resized(images: tuple[Image, ...] | list[Image], like: Image) -> list[Image]:
    """The pictures in the size of another one."""
    return [cv2.resize(image, like.shape[1::-1], interpolation=cv2.INTER_AREA) for image in images]


def brightened(image: Image, gains: float | NDArray[np.floating]) -> Image:
    """Multiply a picture by gains and clip it, as a camera with another gain does."""
    return np.clip(np.rint(image * np.asarray(gains)), 0, 255).astype(np.uint8)
