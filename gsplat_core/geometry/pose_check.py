"""Whether the poses that come with pictures explain how these differ, before anything is built on them.

That a point of inverse depth w is seen at a certain place of another picture is a condition linear in w (triangulation; Hartley and Zisserman 2004, section 12.2). So a
corner that is followed to another picture gives, with the two poses, a least-squares w and a residual that no w removes. With right poses it is small.
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
"""Corners of a picture that are followed."""
APART_PX = 5
"""How far apart they are at least."""
RETURNS_PX = 0.5
"""A corner that is followed to another picture and back has to arrive this near to where it was."""
FEWEST_POINTS = 24
"""That have to be followed to a view, so that it says anything."""
TRACK_ERROR_PX = 0.5
"""Standard deviation of where a corner is found."""
RELIEF = 0.5
"""Standard deviation of the tissue's inverse depth before it is seen, relative to that of the plane that fits best."""
LARGEST_RELIEF = 4.0
"""Nothing is taken to be so many times nearer or farther than that plane."""
LEAST_PARALLAX_PX = 1.5
"""Median parallax of the corners in the view that has most of it: with less, depth is the pictures' noise."""
MOST_LEFT_PX, MOST_LEFT = 1.0, 0.25
"""A view contradicts its pose where the median residual is more than so many pixels, and more than this share of its parallax."""
POSE_ERROR_PX = 0.6
"""Residual of tissue that stands still, by errors of poses and tracking."""
FEWEST_AGREEING = 0.6
"""Share of the views whose poses have to explain their pictures."""
CONTRADICTED = "the poses do not explain how the pictures move: they are wrong, or the tissue itself moves"
"""What is to be said of poses with which fewer of them agree."""
ROUNDS = 6
"""Of iteratively reweighted least squares, so that corners that move by themselves have little weight."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Parallax:
    """What poses and followed corners say together about one picture."""

    inverse_depths: Array
    """[n]: of the corners that agree with the poses."""
    plane: float
    """The inverse depth of the plane that fits best."""
    views: tuple[int, ...]
    """Which of the other views agree with their poses."""
    parallax_px: float
    """How far the median corner moves by parallax in the view where it does so most."""
    own_motion: float
    """The residual that no depth explains, as a share of the parallax, in the median view: tissue that moves by itself. As much motion along the
    parallax is taken for depth, which is then off by about this share, or twice that."""


def explained_by_poses(reference: View, others: Sequence[View]) -> Parallax | str:
    """Depth of corners of `reference` that are followed to the other views, and which of these agree; or, in a sentence, why there is none."""
    corners = _corners(reference)
    tracks = [_followed(reference, view, corners) for view in others]
    usable = [number for number, (_, found) in enumerate(tracks) if found.sum() >= FEWEST_POINTS]
    if not usable:
        return "too few points of the tissue can be followed"
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
            return "the poses move and the pictures hardly do: there is no parallax to find depth from"
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
        return "there is too little parallax to find depth from"
    agree = (seen[kept] & (_off_px(c[kept], d[kept], focal, inverse) < 3 * MOST_LEFT_PX)).any(0)
    own = np.sqrt(np.maximum(off**2 - POSE_ERROR_PX**2, 0)) / np.maximum(moved, LEAST_PARALLAX_PX)
    views = tuple(usable[number] for number in kept)
    return Parallax(inverse[agree], plane, views, float(moved.max()), float(np.median(own)))


def _corners(view: View) -> NDArray[np.float32]:
    """[n, 2]: points of the tissue that can be recognised, as OpenCV counts pixels."""
    found = cv2.goodFeaturesToTrack(
        view.grey.astype(np.uint8), POINTS, 0.005, APART_PX, mask=cv2.erode(view.tissue, np.ones((9, 9), np.uint8))
    )
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)


def _followed(
    reference: View, view: View, corners: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where each corner is in the other picture [n, 2], and whether it was found there, on tissue."""
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
    """[n, 2] each: c and d with w c = d for a corner's inverse depth w, in units of the focal length."""
    between = after.world_to_camera @ np.linalg.inv(before.world_to_camera)
    first, second = _normalised(corners, before), _normalised(target, after)
    ray = np.concatenate([first, np.ones((len(first), 1))], 1) @ between[:3, :3].T
    return second * between[2, 3] - between[:2, 3], ray[:, :2] - second * ray[:, 2:]


def _normalised(pixels: NDArray[np.float32], camera: Camera) -> Array:
    """Rays of pixels whose centres OpenCV has at whole numbers."""
    return np.asarray((pixels.astype(np.float64) + 0.5 - camera.K[:2, 2]) / np.diag(camera.K)[:2])


def _medians(values: Array, seen: NDArray[np.bool_]) -> Array:
    """Of each view's points that were followed, [views]."""
    return np.array([float(np.median(row[mask])) for row, mask in zip(values, seen, strict=True)])


def _plane(c: Array, d: Array, seen: NDArray[np.bool_], focal: float) -> float:
    """The one inverse depth w that fits most of w c = d, both [views, points, 2]."""
    weight, inverse = seen.astype(np.float64), 0.0
    for _ in range(ROUNDS):
        inverse = float((weight * (c * d).sum(-1)).sum() / max((weight * (c * c).sum(-1)).sum(), 1e-20))
        weight = seen * _agreement(c, d, focal, np.full(c.shape[1], inverse))
    return inverse


def _relief(c: Array, d: Array, seen: NDArray[np.bool_], focal: float, plane: float) -> Array:
    """Each point's inverse depth [points], by robust least squares over all views, with the plane as the prior mean."""
    prior = 1 / (RELIEF * plane) ** 2
    inverse = np.full(c.shape[1], plane)
    for _ in range(ROUNDS):
        weight = seen * _agreement(c, d, focal, inverse) * (focal / TRACK_ERROR_PX) ** 2
        told, information = (weight * (c * d).sum(-1)).sum(0), (weight * (c * c).sum(-1)).sum(0)
        inverse = np.clip(
            (told + prior * plane) / (information + prior), plane / LARGEST_RELIEF, plane * LARGEST_RELIEF
        )
    return np.asarray(inverse)


def _agreement(c: Array, d: Array, focal: float, inverse: Array) -> Array:
    """Weights [views, points] with which repeated least squares minimise the sum of distances (L1), which outliers hardly move."""
    return np.asarray(TRACK_ERROR_PX / np.maximum(_off_px(c, d, focal, inverse), TRACK_ERROR_PX))


def _off_px(c: Array, d: Array, focal: float, inverse: Array) -> Array:
    return np.asarray(focal * np.linalg.norm(d - inverse[..., None] * c, axis=-1))
