"""Depth of one picture of a moving scope from other pictures with known poses.

Tracked corners are first checked against the poses (`pose_check`), which also gives the range of
distances. That range is swept (`plane_sweep`) and regularised (`semi_global`). Each pixel's
confidence reflects how well and how uniquely the views match. Deforming or textureless tissue gets
no confidence, and its depth is a smooth extrapolation.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.depth_map import BELIEVED, DepthMap, doubted
from gsplat_core.geometry.plane_sweep import View, sweep
from gsplat_core.geometry.pose_check import Parallax, explained_by_poses
from gsplat_core.geometry.semi_global import aggregated, best_labels
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

WORKING_PX = 320
"""Longest side in pixels of the compared pictures, when there is no real-time limit."""
MOST_VIEWS = 6
"""Largest number of other views compared with one picture."""
SHORTEST_BASELINE = 0.1
"""Share of the longest baseline below which a view is ignored because it adds noise."""
WIDEST_TURN = 0.7
"""Smallest cosine between the optical axes of two cameras that are compared."""
LABEL_PX = 0.75
"""Parallax between neighbouring distances of the sweep, in pixels of the view with the most
parallax.
"""
LABELS = 24, 96
"""Fewest and most distances of a sweep."""
MARGIN = 1.6
"""Factor by which the sweep extends the range of the corners' distances at both ends."""
WORST_COST, BEST_COST = 0.35, 0.15
"""Mean matching cost ((1 - ZNCC) / 2) at which the confidence is 0, and below which it is not
reduced.
"""
UNIQUE = 0.2
"""Relative cost margin to any other depth from which the confidence is not reduced."""
SMALLEST_PATCH = 0.0014
"""Smallest connected patch of confident depth, as a share of the picture; smaller ones are chance
matches.
"""
MOST_OWN_MOTION = 0.06
"""Tissue motion relative to parallax at which the confidence is 0; it decreases from half this
value.
"""
DEFORMS = "the tissue moves too much relative to the scope for depth by parallax"
"""Reason given if no pixel has confident depth."""
FILLED = 0.2
"""Confidence of extrapolated depth."""


def view_of(frame: Frame, camera: Camera, longest_px: int = WORKING_PX) -> View:
    """Reduce a frame so that no side is longer than `longest_px`. `camera` is the frame's camera
    with its pose.
    """
    height, width = frame.image.shape[:2]
    scale = min(1.0, longest_px / max(height, width))
    small = camera.scaled(scale)
    size = small.width_px, small.height_px
    grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
    tissue = np.ones((height, width), np.uint8)
    for mask in (frame.mask, frame.loss_mask, frame.rehearsal_mask):
        if mask is not None:
            tissue &= (mask != 0).astype(np.uint8)
    return View(
        np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32),
        np.asarray(cv2.resize(tissue, size, interpolation=cv2.INTER_NEAREST), np.uint8),
        small,
    )


def chosen_views(reference: View, candidates: Sequence[View]) -> list[View]:
    """Select at most `MOST_VIEWS` candidates facing the same way, evenly spread from the shortest
    useful baseline to the longest.
    """
    axis = reference.camera.world_to_camera[2, :3]
    position = reference.camera.position
    facing = [view for view in candidates if float(axis @ view.camera.world_to_camera[2, :3]) >= WIDEST_TURN]
    far = [float(np.linalg.norm(view.camera.position - position)) for view in facing]
    longest = max(far, default=0.0)
    useful = sorted(
        (each, number) for number, each in enumerate(far) if each > 0 and each >= SHORTEST_BASELINE * longest
    )
    if not useful:
        return []
    picked = np.linspace(0, len(useful) - 1, min(MOST_VIEWS, len(useful))).round().astype(int).tolist()
    return [facing[useful[index][1]] for index in picked]


def depth_of_view(reference: View, candidates: Sequence[View], size: tuple[int, int]) -> DepthMap:
    """Estimate the depth of a picture.

    Args:
        reference: picture whose depth is wanted.
        candidates: other pictures with poses.
        size: height and width of the result.

    Returns:
        Depth in the unit of the poses. The map is rejected if the poses contradict the pictures. If
            the tissue itself moves too much, all confidences are low and the depth is only a rough
            start value.
    """
    others = chosen_views(reference, candidates)
    if not others:
        return doubted(size, DepthOrigin.PARALLAX, "the scope does not move")
    found = explained_by_poses(reference, others)
    if isinstance(found, str):
        return doubted(size, DepthOrigin.PARALLAX, found)
    inverse_depths = _distances(found)
    cost, votes = sweep(reference, [others[number] for number in found.views], inverse_depths)
    labels, unique = best_labels(aggregated(cost))
    inverse = np.interp(labels, np.arange(len(inverse_depths)), inverse_depths).astype(np.float32)
    nearest = np.rint(labels).astype(np.intp)[..., None]
    costs = np.take_along_axis(cost, nearest, 2)[..., 0]
    agreeing = np.take_along_axis(votes, nearest, 2)[..., 0]
    confidence = np.minimum((WORST_COST - costs) / (WORST_COST - BEST_COST), unique / UNIQUE)
    # The end labels also collect everything beyond the range.
    inside = (nearest[..., 0] > 0) & (nearest[..., 0] < len(inverse_depths) - 1)
    confidence = np.clip(confidence, 0, 1) * float(np.clip(2 - 2 * found.own_motion / MOST_OWN_MOTION, 0, 1))
    confidence = confidence * inside * (reference.tissue != 0) * (agreeing >= min(2, len(found.views)))
    confidence = _without_speckles(labels, confidence.astype(np.float32))
    return _at_full_size(*_filled(inverse, confidence, found), size)


def _distances(found: Parallax) -> NDArray[np.float64]:
    """Return evenly spaced inverse depths over the tissue's range; parallax is linear in inverse
    depth.
    """
    low, high = np.percentile(found.inverse_depths, [2, 98])
    low, high = low / MARGIN, high * MARGIN
    span_px = found.parallax_px * (high - low) / found.plane
    return np.linspace(low, high, int(np.clip(round(span_px / LABEL_PX), *LABELS)))


def _without_speckles(labels: NDArray[np.float32], confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """Reduce the confidence of small patches of depth that differ from their surroundings."""
    steps = np.where(confidence >= BELIEVED, labels * 16, -16).astype(np.int16)
    cv2.filterSpeckles(steps, -16, round(SMALLEST_PATCH * steps.size), 24)
    return np.where((steps == -16) & (confidence >= BELIEVED), np.float32(FILLED), confidence)


def _filled(
    inverse: NDArray[np.float32], confidence: NDArray[np.float32], found: Parallax
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Replace unconfident depth by a smooth continuation of the confident depth around it, and far
    from any by the mean plane.
    """
    height, width = inverse.shape
    believed = (confidence >= BELIEVED).astype(np.float32)
    smooth = np.full_like(inverse, found.plane)
    for sigma in (max(height, width) / share for share in (10, 20, 40, 80, 160)):
        weight = cv2.GaussianBlur(believed, (0, 0), sigma)
        near = cv2.GaussianBlur(inverse * believed, (0, 0), sigma)
        smooth = (near + np.float32(0.05) * smooth) / (weight + np.float32(0.05))
    return np.where(believed > 0, inverse, smooth), np.where(
        believed > 0, confidence, np.minimum(confidence, np.float32(FILLED))
    )


def _at_full_size(inverse: NDArray[np.float32], confidence: NDArray[np.float32], size: tuple[int, int]) -> DepthMap:
    full = size[1], size[0]
    depth = 1 / np.asarray(cv2.resize(inverse, full, interpolation=cv2.INTER_LINEAR), np.float32)
    sure = np.asarray(cv2.resize(confidence, full, interpolation=cv2.INTER_LINEAR), np.float32)
    return DepthMap(depth.astype(np.float32), sure, DepthOrigin.PARALLAX, metric=False)
