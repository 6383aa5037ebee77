"""The surface behind matched depth: what neighbours tell together, and of the rest what their noise does not explain.

Disparities are off by less than a tenth of a pixel, but neighbours are off alike, over some ten pixels: too little for depth to suffer, enough to tilt
a surface by 10 degrees. So planes are fitted in windows of a share of the picture; a plane's disparity is linear in the picture. What is left, folds and
edges, is kept by the share of its variance that the disparities' own is too small for (James and Stein's, Wiener's).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.depth_fill import CELLS_A_WINDOW, filled_depth, local_plane
from gsplat_core.geometry.stereo import reach_of, variance_px2
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame

Plane = NDArray[np.float32]

WINDOW = 0.03
"""Standard deviation of the window of a plane, as a share of the picture's width."""
ALIKE_PX2 = 0.1**2
"""Variance that neighbouring disparities have in common, beyond what the matcher says of each, in squares of the pixels that were matched."""


def with_matched_surface(frame: Frame, camera: Camera, tissue: NDArray[np.bool_]) -> Frame:
    """The frame with the surface in place of its matched depth; any other frame as it is.

    camera: the left one. tissue: where depth is that of one surface [H, W]: elsewhere, as on a tool and beside it, it stays as it is and tells nothing.
    """
    if frame.depth is None or frame.depth_confidence is None or frame.depth_origin is not DepthOrigin.STEREO:
        return frame
    known = tissue & (frame.depth > 0) & (frame.depth_confidence > 0)
    if not known.any():
        return frame
    reach = reach_of(frame, camera)
    disparity = np.where(known, reach / np.where(known, frame.depth, 1), 0).astype(np.float32)
    variance = variance_px2(np.where(known, frame.depth_confidence, 1), frame.width_px, ALIKE_PX2)
    surface = smooth_disparity(disparity, known, variance)
    return frame.with_fields(depth=np.where(known, reach / surface, frame.depth).astype(np.float32))


def smooth_disparity(disparity: Plane, known: NDArray[np.bool_], variance: Plane) -> Plane:
    """Disparities [H, W] px, positive where they are `known`, as a surface; `variance` px², positive. Unknown ones mean nothing.

    Never below half of what is known least, nor above twice the most.
    """
    least = float(variance[known].min())
    weight = np.where(known, least / variance, 0).astype(np.float32)
    values = np.where(known, disparity, 1).astype(np.float32)
    rough = np.asarray(1 / filled_depth(np.asarray(1 / values, np.float32), known), np.float32)
    surface = rough + _planes(values - rough, weight)
    rest = np.where(known, values - surface, 0)
    surface = surface + rest * _share_beyond_noise(rest, weight, least)
    low, high = float(values[known].min()), float(values[known].max())
    return np.asarray(np.clip(surface, low / 2, 2 * high), np.float32)


def _planes(values: Plane, weight: Plane) -> Plane:
    """The planes that fit weighted values round each pixel best, each at its pixel [H, W]."""
    height, width = values.shape
    cells = min(width, round(CELLS_A_WINDOW / WINDOW))
    grid = cells, max(1, round(cells * height / width))
    counted = np.asarray(cv2.resize(weight, grid, interpolation=cv2.INTER_AREA), np.float32)
    total = np.asarray(cv2.resize(values * weight, grid, interpolation=cv2.INTER_AREA), np.float32)
    mean = np.asarray(total / np.maximum(counted, 1e-9), np.float32)
    plane = local_plane(mean, counted, max(1.0, WINDOW * cells))
    return np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _share_beyond_noise(rest: Plane, weight: Plane, least: float) -> Plane:
    """How much of what is left of disparities is more than noise, 0 to 1 [H, W]: by its weighted variance round each pixel, of which `least` is noise."""
    sigma = max(1.0, WINDOW * rest.shape[1] / 2)
    mean = lambda plane: cv2.GaussianBlur(plane.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    # The weight is the inverse variance: of noise alone, weight times square is `least` wherever something is known.
    found, noise = mean(weight * rest * rest), least * mean((weight > 0).astype(np.float32))
    return np.asarray(np.clip(1 - noise / np.maximum(found, 1e-12), 0, 1), np.float32)
