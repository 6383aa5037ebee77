"""How well pictures from elsewhere agree with one picture, for a list of distances: a plane sweep (Collins 1996)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera

WINDOW_PX = 7
"""Side of the square in which two pictures are compared."""
NOISE_GREY = 2.0
"""Standard deviation of a picture's noise in grey levels; patches with no more contrast than that do not correlate."""
DISAGREES = 0.5
"""The cost of uncorrelated patches, and the largest one: a view in which the point is hidden must not outvote the others."""
AGREES = 0.2
"""The cost below which a view votes for a distance: a correlation of 0.6."""


@dataclass(frozen=True)
class View:
    """A picture whose camera is known."""

    grey: NDArray[np.float32]
    """[H, W], 0 to 255."""
    tissue: NDArray[np.uint8]
    """[H, W]; 1 where it shows tissue that can be followed."""
    camera: Camera


def sweep(
    reference: View, others: Sequence[View], inverse_depths: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Matching costs of each inverse depth at each pixel of `reference` [H, W, D], from 0 to `DISAGREES`, and how many views vote for it [H, W, D].

    Patches are compared by zero-mean normalised cross-correlation, which does not depend on brightness: the light moves with the scope.
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
    """Where `view` sees what `reference` sees at that inverse depth, for OpenCV's pixels, whose centres are at whole numbers."""
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
    """1 where the whole patch around a pixel is tissue."""
    return np.asarray(cv2.erode((tissue != 0).astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX), np.uint8)), np.float32)


def _cost(
    grey: NDArray[np.float32], mean: NDArray[np.float32], variance: NDArray[np.float32], other: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(1 - ZNCC) / 2 [H, W]."""
    sums = _mean(np.dstack([other, other * other, grey * other]))
    other_mean = sums[..., 0]
    other_variance = np.maximum(sums[..., 1] - other_mean * other_mean, 0) + np.float32(NOISE_GREY**2)
    correlation = (sums[..., 2] - mean * other_mean) / np.sqrt(variance * other_variance)
    return np.asarray(0.5 - 0.5 * correlation, np.float32)
