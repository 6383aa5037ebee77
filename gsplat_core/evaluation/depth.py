"""Errors of rendered depth and normals against true depth, next to the best-fit plane and the level plane of each
frame.

`DepthSums` gives absolute errors for the held-out protocol. `DepthShareSums` and `NormalSums` compare whole sequences
with flat planes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera, pixel_rays, points_of
from gsplat_core.scene.frames import BELIEVED, Frame
from gsplat_core.training.metrics import ScoredMean

Array = NDArray[np.float64]
MOST_STEPS = 100
"""Largest number of Levenberg-Marquardt steps of a plane fit from each start; the fit converges in about ten."""
CONVERGED = 1e-10
"""Relative decrease of the squared error by a step of a plane fit, below which the fit ends."""
STEEPEST_RATIO = 1e-6
"""Lower limit of a fitted plane's inverse depth at a pixel, as a share of the mean inverse depth.

Keeps the plane in front of the camera.
"""


class FlatDepths(NamedTuple):
    """Depths z [N] of the two trivial baselines of a frame at its compared pixels."""

    level: Array
    """Median true depth at every pixel: a plane perpendicular to the optical axis."""
    plane: Array
    """Depth of the tilted plane with the least squared error in z."""


def flat_depths(rays: Array, z: Array) -> FlatDepths | None:
    """Return two trivial depth maps of one frame, fitted to its true depth: a level plane and a tilted plane.

    None for fewer than three pixels.

    Args:
        rays: (x/z, y/z, 1) of the pixels [N, 3].
        z: true depth of the pixels [N], positive and finite.
    """
    plane = best_plane(rays, z)
    return None if plane is None else FlatDepths(np.full(len(z), np.median(z)), 1 / (rays @ plane))


def best_plane(rays: Array, z: Array) -> Array | None:
    """Fit the plane n [3] with n · (x, y, z) = 1 that minimises the sum of (1 / (n · ray) - z)².

    The plane is in front of the camera at every given pixel. The problem is not linear in n.
    Levenberg and Marquardt's method starts from the best level plane and from two linear fits of
    1/z, and the best result is returned. No step that increases the error is accepted, so the
    result is never worse than a level plane. None for fewer than three pixels.

    Args:
        rays: (x/z, y/z, 1) of the pixels [N, 3].
        z: true depth of the pixels [N], positive and finite.
    """
    if len(z) < 3:
        return None
    unit = float(z.mean())
    heights = z / unit
    starts = [np.array([0.0, 0.0, 1.0])]
    # Two linear fits: of relative errors of 1/z, then of errors of z to first order.
    for power in (1, 2):
        weight = heights**power
        found, *_ = np.linalg.lstsq(rays * weight[:, None], weight / heights, rcond=None)
        if (rays @ found).min() > STEEPEST_RATIO:
            starts.append(found)
    ends = [_descended(start, rays, heights) for start in starts]
    best, _ = min(ends, key=lambda end: end[1])
    return best / unit


def _descended(plane: Array, rays: Array, z: Array) -> tuple[Array, float]:
    """Return the plane found by Levenberg-Marquardt steps from the start value `plane`, and its squared error in z."""
    found = 1 / (rays @ plane)
    error, damping = float(np.square(found - z).sum()), 1e-3
    for _ in range(MOST_STEPS):
        slopes = -rays * np.square(found)[:, None]
        normal, gradient = slopes.T @ slopes, slopes.T @ (found - z)
        scale = np.diag(np.diag(normal) + 1e-12 * np.trace(normal))
        before = error
        while damping < 1e12:
            step = np.linalg.solve(normal + damping * scale, gradient)
            inverse = rays @ (plane - step)
            if inverse.min() > STEEPEST_RATIO:
                tried = float(np.square(1 / inverse - z).sum())
                if tried <= error:
                    plane, found, error, damping = plane - step, 1 / inverse, tried, damping / 10
                    break
            damping *= 10
        if before - error <= CONVERGED * before:
            break
    return plane, error


def pixels_to_compare(camera: Camera, where: NDArray[np.bool_], most: int, *planes: NDArray[Any]) -> tuple[Array, ...]:
    """Return the rays (x/z, y/z, 1) [N, 3] of evenly spaced pixels in the mask `where` [H, W], and the values [N] of
    each plane there.

    All pixels of the mask are used if there are fewer than 2 `most`, otherwise between `most` and 1.5 `most` of them.
    """
    chosen = np.flatnonzero(where)
    chosen = chosen[:: max(1, len(chosen) // most)]
    rays = pixel_rays(camera).reshape(-1, 3)[chosen]
    return rays, *(plane.ravel()[chosen].astype(np.float64) for plane in planes)


@dataclass(frozen=True)
class DepthErrors:
    """Depth errors over tissue pixels with known depth, averaged over frames."""

    mae_mm: float
    """Mean absolute depth error in mm."""
    rmse_mm: float
    """Root mean square depth error in mm."""
    relative: float
    """Mean over the pixels of the absolute depth error divided by the true depth."""
    scaled_rmse_mm: float
    """RMSE after scaling each frame by its median of true over rendered depth; measures shape alone."""
    covered: float
    """Share of tissue pixels with known depth at which the model has depth. Other pixels add no error."""
    frames: int


class DepthSums:
    """Streaming accumulator of per-frame depth errors; the result is `errors`."""

    def __init__(self) -> None:
        self._means = {name: ScoredMean() for name in ("mae_mm", "rmse_mm", "relative", "scaled_rmse_mm", "covered")}
        self._frames = 0

    def add(self, frame: Frame, depth: NDArray[np.float32]) -> float:
        """Add a frame: compare rendered depth z [H, W], 0 = unknown, with the frame's depth on tissue.

        Returns:
            Mean absolute error in the unit of the frame's depth, NaN if nothing is comparable.
        """
        if frame.depth is None:
            return math.nan
        known = np.isfinite(frame.depth) & (frame.depth > 0)
        if frame.depth_confidence is not None:
            known &= frame.depth_confidence >= BELIEVED
        if frame.tissue is not None:
            known &= frame.tissue != 0
        count = int(known.sum())
        if not count:
            return math.nan
        self._frames += 1
        both = known & np.isfinite(depth) & (depth > 0)
        self._means["covered"].add(int(both.sum()) / count)
        if not both.any():
            return math.nan
        true, shown = frame.depth[both].astype(np.float64), depth[both].astype(np.float64)
        error = np.abs(shown - true)
        scaled = shown * np.median(true / shown) - true
        mae = float(error.mean())
        self._means["mae_mm"].add(mae)
        self._means["rmse_mm"].add(math.sqrt(float(np.square(error).mean())))
        self._means["relative"].add(float((error / true).mean()))
        self._means["scaled_rmse_mm"].add(math.sqrt(float(np.square(scaled).mean())))
        return mae

    @property
    def errors(self) -> DepthErrors | None:
        """Depth errors averaged over the frames added so far; None if no frame was comparable."""
        means = {name: mean.mean for name, mean in self._means.items()}
        found = {name: value for name, value in means.items() if value is not None}
        return DepthErrors(**found, frames=self._frames) if len(found) == len(means) else None


MOST_DEPTH_PIXELS = 8192
"""Number of evenly spaced pixels compared per frame (up to twice as many), to bound memory."""


@dataclass(frozen=True)
class DepthShare:
    """Depth errors over all compared pixels of all frames of a sequence, with flat planes as baselines.

    Compared are tissue pixels with known depth at which the model has depth.
    """

    rmse_share: float
    """Root mean square depth error over all compared pixels, divided by the median true depth."""
    scaled_rmse_share: float
    """`rmse_share` after the model's depth is multiplied by `scale`; measures the shape alone."""
    plane_rmse_share: float
    """Baseline: `rmse_share` of the plane that fits each frame's true depth best (`FlatDepths.plane`)."""
    level_rmse_share: float
    """Baseline: `rmse_share` of the level plane at each frame's median true depth (`FlatDepths.level`)."""
    median_share: float
    """Median over the compared pixels of the absolute error divided by the true depth, after scaling by `scale`."""
    rmse: float
    """Root mean square depth error over all compared pixels, in the unit of the recording's depth."""
    scale: float
    """Scale factor of the whole sequence: the median of true depth over model depth."""
    median_depth: float
    covered: float
    """Share of tissue pixels with known depth at which the model has depth."""
    frames: int


class DepthShareSums:
    """Streaming accumulator of depth samples, at most `MOST_DEPTH_PIXELS` per frame."""

    def __init__(self) -> None:
        self._kept: list[NDArray[np.float64]] = []
        self._known = self._both = 0

    def add(self, camera: Camera, true: NDArray[Any], shown: NDArray[Any], known: NDArray[np.bool_]) -> None:
        """Compare rendered depth z [H, W], 0 = empty, with the true depth where known."""
        both = known & np.isfinite(shown) & (shown > 0)
        self._known += int(known.sum())
        self._both += int(both.sum())
        rays, *values = pixels_to_compare(camera, both, MOST_DEPTH_PIXELS, true, shown)
        flat = flat_depths(rays, values[0])
        if flat is not None:
            self._kept.append(np.stack([*values, flat.plane, flat.level]))

    @property
    def errors(self) -> DepthShare | None:
        """Depth errors over all frames added so far; None if no pixel was comparable."""
        if not self._kept:
            return None
        true, shown, plane, level = np.concatenate(self._kept, axis=1)
        scale, median = float(np.median(true / shown)), float(np.median(true))
        rmse = lambda found: float(np.sqrt(np.mean(np.square(found - true))))
        return DepthShare(
            rmse_share=rmse(shown) / median,
            scaled_rmse_share=rmse(scale * shown) / median,
            plane_rmse_share=rmse(plane) / median,
            level_rmse_share=rmse(level) / median,
            median_share=float(np.median(np.abs(scale * shown - true) / true)),
            rmse=rmse(shown),
            scale=scale,
            median_depth=median,
            covered=self._both / self._known,
            frames=len(self._kept),
        )


MOST_PLANE_PIXELS = 8192
"""Number of evenly spaced pixels per frame (up to twice as many) used to fit its plane."""
SMOOTH_PX = 5
"""Width in pixels of the window that smooths depth before normals are computed from it; quantised depth has steps."""


@dataclass(frozen=True)
class NormalErrors:
    """Angles in degrees between true and rendered normals, averaged over frames."""

    mean_deg: float
    median_deg: float
    plane_mean_deg: float
    """Baseline: mean angular error of a flat plane that is fitted to the true depth of each frame (`best_plane`)."""
    level_mean_deg: float
    """Baseline: mean angular error in degrees of a level plane, whose normal is along the optical axis, towards the camera."""
    frames: int


def normals_of(
    camera: Camera, depth: NDArray[Any], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Compute unit normals [H, W, 3] towards the camera from a depth map z [H, W].

    Returns:
        Normals and a mask of pixels with known depth all around.
    """
    points = points_of(camera, np.where(known, depth, 0))
    smooth = cv2.blur(points, (SMOOTH_PX, SMOOTH_PX), borderType=cv2.BORDER_REPLICATE)
    normal = np.cross(np.gradient(smooth, axis=0), np.gradient(smooth, axis=1))
    length = np.linalg.norm(normal, axis=-1)
    reach = np.ones((SMOOTH_PX + 2, SMOOTH_PX + 2), np.uint8)
    inside = cv2.erode(known.astype(np.uint8), reach, borderType=cv2.BORDER_CONSTANT, borderValue=0) != 0
    there = np.asarray(inside & (length > 0))
    normal /= np.where(length > 0, length, 1)[..., None]
    return normal, there


class NormalSums:
    """Streaming accumulator of normal errors; both normals are computed from depth in the same way."""

    def __init__(self) -> None:
        self._mean, self._median, self._plane, self._level = (ScoredMean() for _ in range(4))

    def add(self, camera: Camera, true: NDArray[Any], shown: NDArray[Any], known: NDArray[np.bool_]) -> None:
        """Compare the surface of rendered depth z [H, W], 0 = empty, with the true surface where known."""
        compared = known & np.isfinite(shown) & (shown > 0)
        right, both = normals_of(camera, true, compared)
        found, _ = normals_of(camera, shown, compared)
        if not both.any():
            return
        plane = best_plane(*pixels_to_compare(camera, compared, MOST_PLANE_PIXELS, true))
        if plane is None:
            return
        angles = _degrees(np.einsum("ni,ni->n", right[both], found[both]))
        self._mean.add(float(angles.mean()))
        self._median.add(float(np.median(angles)))
        self._plane.add(float(_degrees(right[both] @ (-plane / np.linalg.norm(plane))).mean()))
        self._level.add(float(_degrees(-right[both][:, 2]).mean()))

    @property
    def errors(self) -> NormalErrors | None:
        """Angular errors averaged over the frames added so far; None if no frame was comparable."""
        mean, median, plane, level = (each.mean for each in (self._mean, self._median, self._plane, self._level))
        if mean is None or median is None or plane is None or level is None:
            return None
        return NormalErrors(mean, median, plane, level, self._mean.count)


def _degrees(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
