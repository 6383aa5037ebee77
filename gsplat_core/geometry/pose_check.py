"""Consistency check between given camera poses and the observed image motion.

For given poses, the position of a point in another picture is linear in its inverse depth w
(triangulation; Hartley and Zisserman 2004, section 12.2). A tracked corner therefore gives a
least-squares w and a residual that no w removes. The residual is small if the poses are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.plane_sweep import View
from gsplat_core.geometry.point_flow import followed
from gsplat_core.scene.cameras import Camera

POINTS = 400
"""Largest number of tracked corners."""
APART_PX = 5
"""Smallest distance between corners in pixels."""
RETURNS_PX = 0.5
"""Largest accepted forward-backward error in pixels."""
FEWEST_POINTS = 24
"""Fewest tracked corners from which a view is used."""
TRACK_ERROR_PX = 0.5
"""Standard deviation of a tracked position in pixels."""
RELIEF = 0.5
"""Prior standard deviation of inverse depth, relative to that of the best-fitting plane."""
LARGEST_RELIEF = 4.0
"""Bound of the ratio between a point's inverse depth and that of the plane."""
LEAST_PARALLAX_PX = 1.5
"""Smallest median parallax in pixels, in the view with the most parallax; with less, depth is
noise.
"""
MOST_LEFT_PX, MOST_LEFT = 1.0, 0.25
"""A view contradicts its pose if its median residual exceeds both this many pixels and this share
of its parallax.
"""
POSE_ERROR_PX = 0.6
"""Residual of static tissue in pixels, from errors of poses and tracking."""
FEWEST_AGREEING = 0.6
"""Share of the views whose poses must explain their pictures."""
CONTRADICTED = "the poses do not explain how the pictures move: they are wrong, or the tissue itself moves"
"""Reason given if fewer views agree with their poses."""
ROUNDS = 6
"""Rounds of iteratively reweighted least squares, which reduces the weight of corners on moving
objects.
"""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Parallax:
    """Depth of tracked corners and consistency of the poses for one picture."""

    inverse_depths: Array
    """Inverse depths of the corners that agree with the poses, [n]."""
    plane: float
    """Inverse depth of the best-fitting fronto-parallel plane."""
    views: tuple[int, ...]
    """Indices of the views that agree with their poses."""
    parallax_px: float
    """Median parallax in pixels in the view with the most parallax."""
    own_motion: float
    """Median residual that no depth explains, as a share of the parallax: the tissue's own motion.
    Motion along the parallax direction is mistaken for depth, so the relative depth error is about
    this share, or up to twice as large.
    """


def explained_by_poses(reference: View, others: Sequence[View]) -> Parallax | str:
    """Check poses with corners tracked from `reference` to the other views.

    Returns:
        The corners' depths and the agreeing views, or the reason for rejection as a sentence.
    """
    corners = _corners(reference)
    tracks = [_followed(reference, view, corners) for view in others]
    usable = [number for number, (_, found) in enumerate(tracks) if found.sum() >= FEWEST_POINTS]
    if not usable:
        return "too few points of the tissue can be tracked"
    terms = [_terms(corners, tracks[number][0], reference.camera, others[number].camera) for number in usable]
    c, d = (np.stack(each) for each in zip(*terms, strict=True))
    seen = np.stack([tracks[number][1] for number in usable])
    focal = float(reference.camera.K[0, 0])
    kept = list(range(len(usable)))
    while True:
        plane = _plane(c[kept], d[kept], seen[kept], focal)
        moved = _medians(focal * abs(plane) * np.linalg.norm(c[kept], axis=2), seen[kept])
        shown = _medians(focal * np.linalg.norm(d[kept], axis=2), seen[kept])
        if moved.max() < LEAST_PARALLAX_PX and shown.max() < 2 * LEAST_PARALLAX_PX:
            return "the poses move but the pictures hardly do: there is no parallax to estimate depth from"
        inverse = _relief(c[kept], d[kept], seen[kept], focal, max(plane, 1e-12))
        off = _medians(_off_px(c[kept], d[kept], focal, inverse), seen[kept])
        excess = off / np.maximum(MOST_LEFT_PX, MOST_LEFT * moved)
        worst = int(excess.argmax())
        if plane > 0 and excess[worst] <= 1:
            break
        kept.pop(worst)
        if len(kept) < max(1, FEWEST_AGREEING * len(usable)):
            return CONTRADICTED
    if moved.max() < LEAST_PARALLAX_PX:
        return "there is too little parallax to estimate depth from"
    agree = (seen[kept] & (_off_px(c[kept], d[kept], focal, inverse) < 3 * MOST_LEFT_PX)).any(0)
    own = np.sqrt(np.maximum(off**2 - POSE_ERROR_PX**2, 0)) / np.maximum(moved, LEAST_PARALLAX_PX)
    views = tuple(usable[number] for number in kept)
    return Parallax(inverse[agree], plane, views, float(moved.max()), float(np.median(own)))


def _corners(view: View) -> NDArray[np.float32]:
    """Return trackable corners of the tissue in OpenCV pixel coordinates [n, 2]."""
    found = cv2.goodFeaturesToTrack(
        view.grey.astype(np.uint8), POINTS, 0.005, APART_PX, mask=cv2.erode(view.tissue, np.ones((9, 9), np.uint8))
    )
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)


def _followed(
    reference: View, view: View, corners: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the position of each corner in the other picture [n, 2], and which were found on
    tissue [n].
    """
    first, second = (each.grey.astype(np.uint8) for each in (reference, view))
    there, misses_px = followed(first, second, corners, window_px=15, levels=4)
    height, width = view.tissue.shape
    column, row = (
        np.clip(np.nan_to_num(there[:, axis]), 0, size - 1).astype(int) for axis, size in ((0, width), (1, height))
    )
    return there, (misses_px < RETURNS_PX) & (view.tissue[row, column] > 0)


def _terms(
    corners: NDArray[np.float32], target: NDArray[np.float32], before: Camera, after: Camera
) -> tuple[Array, Array]:
    """Return c and d [n, 2] of the equation w c = d for the corners' inverse depths w, in units of
    the focal length.
    """
    between = after.world_to_camera @ np.linalg.inv(before.world_to_camera)
    first, second = _normalised(corners, before), _normalised(target, after)
    ray = np.concatenate([first, np.ones((len(first), 1))], 1) @ between[:3, :3].T
    return second * between[2, 3] - between[:2, 3], ray[:, :2] - second * ray[:, 2:]


def _normalised(pixels: NDArray[np.float32], camera: Camera) -> Array:
    """Convert OpenCV pixel coordinates to rays."""
    return np.asarray((pixels.astype(np.float64) + 0.5 - camera.K[:2, 2]) / np.diag(camera.K)[:2])


def _medians(values: Array, seen: NDArray[np.bool_]) -> Array:
    """Return the median over each view's tracked points [views]."""
    return np.array([float(np.median(row[mask])) for row, mask in zip(values, seen, strict=True)])


def _plane(c: Array, d: Array, seen: NDArray[np.bool_], focal: float) -> float:
    """Return one inverse depth that robustly fits w c = d; c and d are [views, points, 2]."""
    weight, inverse = seen.astype(np.float64), 0.0
    for _ in range(ROUNDS):
        inverse = float((weight * (c * d).sum(-1)).sum() / max((weight * (c * c).sum(-1)).sum(), 1e-20))
        weight = seen * _agreement(c, d, focal, np.full(c.shape[1], inverse))
    return inverse


def _relief(c: Array, d: Array, seen: NDArray[np.bool_], focal: float, plane: float) -> Array:
    """Return each point's inverse depth [points] by robust least squares over all views, with the
    plane as prior mean.
    """
    prior = 1 / (RELIEF * plane) ** 2
    inverse = np.full(c.shape[1], plane)
    for _ in range(ROUNDS):
        weight = seen * _agreement(c, d, focal, inverse) * (focal / TRACK_ERROR_PX) ** 2
        evidence, information = (weight * (c * d).sum(-1)).sum(0), (weight * (c * c).sum(-1)).sum(0)
        inverse = np.clip(
            (evidence + prior * plane) / (information + prior), plane / LARGEST_RELIEF, plane * LARGEST_RELIEF
        )
    return np.asarray(inverse)


def _agreement(c: Array, d: Array, focal: float, inverse: Array) -> Array:
    """Return weights [views, points] for iteratively reweighted least squares that minimise the
    robust L1 norm.
    """
    return np.asarray(TRACK_ERROR_PX / np.maximum(_off_px(c, d, focal, inverse), TRACK_ERROR_PX))


def _off_px(c: Array, d: Array, focal: float, inverse: Array) -> Array:
    return np.asarray(focal * np.linalg.norm(d - inverse[..., None] * c, axis=-1))
