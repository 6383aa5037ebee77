"""A small video of tissue that shifts, and a camera for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

WIDTH_PX, HEIGHT_PX = 48, 40


def texture(width: int, height: int, shift_px: float) -> NDArray[np.uint8]:
    """Return smooth coloured waves of about 15 px, shifted to the right by `shift_px`."""
    y, x = np.mgrid[:height, :width] + 0.5
    x = x - shift_px
    waves = [np.sin(0.40 * x + 0.15 * y), np.sin(0.31 * x - 0.28 * y + 1), np.sin(0.22 * x + 0.37 * y + 2)]
    return np.rint(255 * (0.5 + 0.35 * np.stack(waves, -1))).astype(np.uint8)


@pytest.fixture
def camera() -> Camera:
    """Camera of the frames of `make_frame`."""
    return Camera.from_focal(50.0, WIDTH_PX, HEIGHT_PX)


@pytest.fixture
def make_frame() -> Callable[..., Frame]:
    """`make_frame(seq, fps=20, shift_px=0, width, height, **fields)`: one frame; fields are Frame's mask, depth, pose."""

    def make(
        seq: int = 0,
        fps: float = 20,
        shift_px: float = 0,
        width: int = WIDTH_PX,
        height: int = HEIGHT_PX,
        **fields: object,
    ) -> Frame:
        return Frame(seq, round(seq * 1e9 / fps), texture(width, height, shift_px), **fields)  # type: ignore[arg-type]

    return make


@pytest.fixture
def tissue_video(make_frame: Callable[..., Frame]) -> Callable[..., list[Frame]]:
    """`tissue_video(count, amplitude_px=4, **fields)`: the tissue swings to the right and back once in 1.6 s."""

    def make(count: int, amplitude_px: float = 4, **fields: object) -> list[Frame]:
        shift = lambda seq: amplitude_px * (1 - np.cos(2 * np.pi * seq / 32)) / 2
        return [make_frame(seq, shift_px=shift(seq), **fields) for seq in range(count)]

    return make
