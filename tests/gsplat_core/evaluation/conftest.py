"""Small videos with scores that are known analytically."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gsplat_core.evaluation.protocols import Picture
from gsplat_core.scene.frames import Frame

HEIGHT, WIDTH = 16, 20


def make_frame(seq: int, level: int = 100, **fields: Any) -> Frame:
    """Return a frame of one uniform grey level, at 25 frames per second."""
    return Frame(seq, seq * 40_000_000, np.full((HEIGHT, WIDTH, 3), level, np.uint8), **fields)


def make_picture(level: float, version: int = 1, depth: float = 0.0) -> Picture:
    """Return a rendered picture of one grey level, which need not be an 8-bit level."""
    unrounded = np.full((HEIGHT, WIDTH, 3), level / 255, np.float32)
    image = np.rint(unrounded * 255).astype(np.uint8)
    return Picture(image, unrounded, np.full((HEIGHT, WIDTH), depth, np.float32), version)


@pytest.fixture
def frame() -> Callable[..., Frame]:
    return make_frame


@pytest.fixture
def picture() -> Callable[..., Picture]:
    return make_picture


@pytest.fixture
def decibels() -> Callable[[float], float]:
    """Return the PSNR of a picture that differs by this number of grey levels everywhere."""
    return lambda difference: float(-20 * np.log10(difference / 255))
