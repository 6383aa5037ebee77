"""Optical flow of the tissue, from picture to picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.training.image_motion import ImageMotion, revealed_px, typical_px


def texture(shift_x: float, shift_y: float, size: tuple[int, int] = (96, 128)) -> NDArray[np.uint8]:
    """Return a smooth random picture, moved."""
    noise = np.random.default_rng(0).uniform(0, 255, (size[0] + 104, size[1] + 112, 3)).astype(np.float32)
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), np.empty(0), 0, 255, cv2.NORM_MINMAX)
    height, width = size
    moved = cv2.warpAffine(smooth, np.array([[1, 0, shift_x - 40], [0, 1, shift_y - 40]], np.float32), (width, height))
    return moved.astype(np.uint8)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.5, -0.75), (4.0, 2.0)])
def test_image_motion_measures_shift(shift: tuple[float, float]) -> None:
    motion = ImageMotion()
    assert motion.follow(texture(0, 0), None) is None
    flow = motion.follow(texture(*shift), None)
    assert flow is not None and flow.shape == (24, 32, 2)
    assert np.abs(np.median(flow.reshape(-1, 2), axis=0) - shift).max() < 0.1
    assert abs(typical_px(flow) - np.hypot(*shift)) < 0.15


@pytest.mark.parametrize("size", [(96, 128), (420, 501)])
def test_half_detail_image_motion_is_in_full_size_pixels(size: tuple[int, int]) -> None:
    motion = ImageMotion("half")
    motion.follow(texture(0, 0, size), None)
    flow = motion.follow(texture(3, -2, size), None)
    assert flow is not None and flow.shape == (round(size[0] / 4), round(size[1] / 4), 2)
    assert np.abs(np.median(flow.reshape(-1, 2), axis=0) - (3, -2)).max() < 0.2


def test_image_motion_under_mask_follows_surrounding_tissue() -> None:
    still, moved = texture(0, 0), texture(2, 0)
    mask = np.ones((96, 128), np.uint8)
    mask[30:60, 40:80] = 0
    for picture in (still, moved):
        picture[mask == 0] = 90  # a tool that does not move
    motion = ImageMotion()
    motion.follow(still, mask)
    flow = motion.follow(moved, mask)
    assert flow is not None
    assert abs(float(flow[11, 15, 0]) - 2) < 0.3


def test_image_motion_is_none_for_first_resized_or_tiny_picture() -> None:
    motion = ImageMotion()
    assert motion.follow(texture(0, 0), None) is None
    assert motion.follow(texture(0, 0, (64, 128)), None) is None
    motion.forget()
    assert motion.follow(texture(0, 0, (64, 128)), None) is None
    for _ in range(2):
        assert motion.follow(np.zeros((8, 8, 3), np.uint8), None) is None


def test_image_motion_without_tissue_or_texture_is_zero() -> None:
    motion = ImageMotion()
    black, nothing = np.zeros((96, 128, 3), np.uint8), np.zeros((96, 128), np.uint8)
    motion.follow(black, nothing)
    flow = motion.follow(texture(0, 0), nothing)
    assert flow is not None and np.isfinite(flow).all()
    assert not flow.any()


def test_revealed_px_is_width_of_strip_at_edges():
    flow = np.zeros((8, 10, 2), np.float32)
    assert revealed_px(flow) == 0
    flow[..., 0] = 3.0  # to the right: the left edge shows something new
    assert revealed_px(flow) == 3
    flow[..., 0] = -2.0
    assert revealed_px(flow) == 2
    flow[..., 1] = np.linspace(-1, 1, 8)[:, None]  # apart from the middle: nothing comes in above or below
    assert revealed_px(flow) == 2
    flow[...] = 0
    flow[..., 1] = np.linspace(4, -4, 8)[:, None]  # the picture shrinks
    assert revealed_px(flow) == 4
