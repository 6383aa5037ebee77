"""Surface reconstruction from stereo disparities by local planes and Wiener shrinkage of the
residual.

Errors of disparities are below a tenth of a pixel but correlated over about ten pixels. That is
harmless for depth but tilts a surface by up to 10 degrees. Planes are therefore fitted in larger
windows; the disparity of a plane is linear in picture coordinates. The residual, folds and edges,
is kept by the share of its variance that exceeds the noise (James-Stein and Wiener estimators).
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
"""Standard deviation of a plane's window, as a share of the picture's width."""
ALIKE_PX2 = 0.1**2
"""Variance of the error shared by neighbouring disparities, in squared pixels of the matched
pictures. It is added to the variance that the matcher estimates.
"""


def with_matched_surface(frame: Frame, camera: Camera, tissue: NDArray[np.bool_]) -> Frame:
    """Replace the stereo depth of a frame by a reconstructed surface; frames with other depth are
    returned unchanged.

    Args:
        frame: frame with stereo depth and confidence.
        camera: left camera.
        tissue: bool [H, W], pixels whose depth belongs to the tissue surface. Other pixels, such as
            tools and their surroundings, keep their depth and are ignored by the fit.
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
    """Fit a surface to disparities.

    Args:
        disparity: float32 [H, W] in pixels, positive where known.
        known: bool [H, W].
        variance: float32 [H, W] in pixels², positive.

    Returns:
        Disparity [H, W] between half the smallest and twice the largest known value; meaningless
            where unknown.
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
    """Return the weighted plane fit around each pixel, evaluated at the pixel [H, W]."""
    height, width = values.shape
    cells = min(width, round(CELLS_A_WINDOW / WINDOW))
    grid = cells, max(1, round(cells * height / width))
    counted = np.asarray(cv2.resize(weight, grid, interpolation=cv2.INTER_AREA), np.float32)
    total = np.asarray(cv2.resize(values * weight, grid, interpolation=cv2.INTER_AREA), np.float32)
    mean = np.asarray(total / np.maximum(counted, 1e-9), np.float32)
    plane = local_plane(mean, counted, max(1.0, WINDOW * cells))
    return np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _share_beyond_noise(rest: Plane, weight: Plane, least: float) -> Plane:
    """Return the share of the residual that exceeds noise, 0 to 1 [H, W], from its locally weighted
    variance and the noise variance `least`.
    """
    sigma = max(1.0, WINDOW * rest.shape[1] / 2)
    mean = lambda plane: cv2.GaussianBlur(plane.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    # Weights are `least` / variance, so weight times squared noise has the mean `least` at every
    # known pixel.
    found, noise = mean(weight * rest * rest), least * mean((weight > 0).astype(np.float32))
    return np.asarray(np.clip(1 - noise / np.maximum(found, 1e-12), 0, 1), np.float32)
