"""Depth of one picture of a moving scope, from pictures of the same tissue from elsewhere whose poses are known.

First corners that are followed are held against the poses (`pose_check`), which also says between which distances the tissue is. Then these distances are swept
(`plane_sweep`), neighbours are made to agree (`semi_global`), and each pixel is judged by how well and how clearly the views agree there. What deforms
does not agree between times, and what has no texture does not agree clearly: both get no confidence, and a depth that is only a smooth continuation.
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
"""Longest side of the pictures that are compared, where there is time."""
MOST_VIEWS = 6
"""Other views that are compared with one picture."""
SHORTEST_BASELINE = 0.1
"""Of the longest one: views nearer than that add noise and no depth."""
WIDEST_TURN = 0.7
"""Cosine of the angle between two cameras' axes from which they may see the same tissue."""
LABEL_PX = 0.75
"""Parallax from one distance of the sweep to the next, in the view that has most of it."""
LABELS = 24, 96
"""Fewest and most distances of a sweep."""
MARGIN = 1.6
"""How many times nearer and farther than the corners are is looked for."""
WORST_COST, BEST_COST = 0.35, 0.15
"""Mean cost (half of 1 - ZNCC) from which a depth is not believed at all, and below which nothing speaks against it."""
UNIQUE = 0.2
"""How much more, relatively, any other depth has to cost for nothing to speak against this one."""
SMALLEST_PATCH = 0.0014
"""Share of the picture that a connected patch of depth has at least; less is a chance agreement."""
MOST_OWN_MOTION = 0.06
"""Motion of the tissue's own, relative to parallax, with which no depth is believed; from half of it on confidence falls."""
DEFORMS = "the tissue itself moves too much beside the scope for depth to be told from parallax"
"""What is to be said of a depth that is believed nowhere."""
FILLED = 0.2
"""Confidence of a depth that is only continued from its surroundings."""


def view_of(frame: Frame, camera: Camera, longest_px: int = WORKING_PX) -> View:
    """A frame with no side longer than `longest_px`, seen by `camera`, which has the frame's pose."""
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
    """At most `MOST_VIEWS` of the candidates that may see the same tissue, from the shortest useful baseline to the longest."""
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
    """Depth for pictures of `size` (height, width), in the unit of the poses; doubted where the poses do not explain the pictures.

    Where the tissue itself moves too much, none of it is believed; it is still the rough distance at which a scene may start.
    """
    others = chosen_views(reference, candidates)
    if not others:
        return doubted(size, DepthOrigin.PARALLAX, "the scope stands still")
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
    # The nearest and the farthest distance stand for all beyond them.
    inside = (nearest[..., 0] > 0) & (nearest[..., 0] < len(inverse_depths) - 1)
    confidence = np.clip(confidence, 0, 1) * float(np.clip(2 - 2 * found.own_motion / MOST_OWN_MOTION, 0, 1))
    confidence = confidence * inside * (reference.tissue != 0) * (agreeing >= min(2, len(found.views)))
    confidence = _without_speckles(labels, confidence.astype(np.float32))
    return _at_full_size(*_filled(inverse, confidence, found), size)


def _distances(found: Parallax) -> NDArray[np.float64]:
    """Inverse depths between which the tissue is, evenly spaced: so is parallax then."""
    low, high = np.percentile(found.inverse_depths, [2, 98])
    low, high = low / MARGIN, high * MARGIN
    span_px = found.parallax_px * (high - low) / found.plane
    return np.linspace(low, high, int(np.clip(round(span_px / LABEL_PX), *LABELS)))


def _without_speckles(labels: NDArray[np.float32], confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """Small patches of believed depth that differ from all around them are not believed."""
    steps = np.where(confidence >= BELIEVED, labels * 16, -16).astype(np.int16)
    cv2.filterSpeckles(steps, -16, round(SMALLEST_PATCH * steps.size), 24)
    return np.where((steps == -16) & (confidence >= BELIEVED), np.float32(FILLED), confidence)


def _filled(
    inverse: NDArray[np.float32], confidence: NDArray[np.float32], found: Parallax
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where a depth is not believed it continues smoothly what is believed around it, and far from that the plane that fits best."""
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
