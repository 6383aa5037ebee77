"""Plane sweep (Collins 1996): matching costs of one picture with other views for a list of inverse
depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera

WINDOW_PX = 7
"""Side of the correlation window in pixels."""
NOISE_GREY = 2.0
"""Standard deviation of image noise in grey levels, added to variances so that patches without
contrast do not correlate.
"""
DISAGREES = 0.5
"""Cost of uncorrelated patches, also the upper bound, so that an occluded view cannot outvote the
others.
"""
AGREES = 0.2
"""Cost below which a view votes for a distance, corresponding to a correlation of 0.6."""


@dataclass(frozen=True)
class View:
    """Grey picture with its camera."""

    grey: NDArray[np.float32]
    """Grey levels 0 to 255, float32 [H, W]."""
    tissue: NDArray[np.uint8]
    """Validity uint8 [H, W]; 1 on tissue that can be tracked."""
    camera: Camera


def sweep(
    reference: View, others: Sequence[View], inverse_depths: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Compute matching costs by zero-mean normalised cross-correlation, which is invariant to the
    brightness changes of a moving light.

    Args:
        reference: picture whose depth is wanted.
        others: views to compare with.
        inverse_depths: float64 [D].

    Returns:
        Mean costs float32 [H, W, D] from 0 to `DISAGREES`, and numbers of agreeing views uint8 [H,
            W, D].
    """
    height, width = reference.grey.shape
    cost = np.empty((len(inverse_depths), height, width), np.float32)
    votes = np.empty((len(inverse_depths), height, width), np.uint8)
    mean, variance = _moments(reference.grey)
    whole = _whole_patches(reference.tissue)
    stacks = [np.dstack([view.grey, _whole_patches(view.tissue)]) for view in others]
    for index, inverse in enumerate(inverse_depths):
        total = np.zeros((height, width), np.float32)
        seen, agree = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
        for view, stack in zip(others, stacks, strict=True):
            moved: Any = cv2.warpPerspective(
                stack, _plane_homography(reference.camera, view.camera, inverse), (width, height),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            )  # fmt: skip
            grey, usable = moved[..., 0], (moved[..., 1] > 0.99) & (whole > 0)
            each = np.minimum(_cost(reference.grey, mean, variance, grey), np.float32(DISAGREES))
            total += np.where(usable, each, 0)
            seen += usable
            agree += usable & (each < AGREES)
        cost[index] = np.where(seen > 0, total / np.maximum(seen, 1), DISAGREES)
        votes[index] = agree
    return np.ascontiguousarray(cost.transpose(1, 2, 0)), np.ascontiguousarray(votes.transpose(1, 2, 0))


def _plane_homography(reference: Camera, view: Camera, inverse_depth: float) -> NDArray[np.float64]:
    """Return the homography from `reference` to `view` for a fronto-parallel plane, in OpenCV pixel
    coordinates (pixel centres at integers).
    """
    between = view.world_to_camera @ np.linalg.inv(reference.world_to_camera)
    centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    plane = between[:3, :3] + np.outer(between[:3, 3], [0, 0, inverse_depth])
    return np.asarray(np.linalg.inv(centre) @ view.K @ plane @ np.linalg.inv(reference.K) @ centre)


def _mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.boxFilter(values, -1, (WINDOW_PX, WINDOW_PX)), np.float32)


def _moments(grey: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    mean = _mean(grey)
    return mean, np.maximum(_mean(grey * grey) - mean * mean, 0) + np.float32(NOISE_GREY**2)


def _whole_patches(tissue: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return 1 where the whole correlation window is tissue."""
    return np.asarray(cv2.erode((tissue != 0).astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX), np.uint8)), np.float32)


def _cost(
    grey: NDArray[np.float32], mean: NDArray[np.float32], variance: NDArray[np.float32], other: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return (1 - ZNCC) / 2 [H, W]."""
    sums = _mean(np.dstack([other, other * other, grey * other]))
    other_mean = sums[..., 0]
    other_variance = np.maximum(sums[..., 1] - other_mean * other_mean, 0) + np.float32(NOISE_GREY**2)
    correlation = (sums[..., 2] - mean * other_mean) / np.sqrt(variance * other_variance)
    return np.asarray(0.5 - 0.5 * correlation, np.float32)
