"""Measurement of points, distances and lengths on a model's surface, each with a standard error.

The standard error of a point has two independent parts: the depth ambiguity of pixels that show several surfaces, and
the error of the model's depth (`DepthSource.relative_error`). Half of the variance of the second part is a scale error
of the whole scene. The other half is independent between two points. The thickness of the splats and the opacity of a
pixel do not predict its depth error, so they are not part of it. The camera is assumed exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.mesh import in_world, rays_of
from gsplat_core.models import Model
from gsplat_core.rendering.surface import COVERED, Surface
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import UNKNOWN_ERROR
from gsplat_core.transfers import HostCopy

MOST_STEPS = 4096
"""Largest number of straight pieces into which a path along the surface is divided."""
STEP_PX = 2.0
"""Distance in pixels between the sampled points of a path along the surface."""
COMMON = 0.5
"""Share of the variance of the depth source's error that is a scale error common to the whole scene."""
SMOOTHED_SPLATS = 3.0
"""Standard deviation of the filter of depths along a path, in distances between neighbouring splats. Neighbouring splats
have independent depth errors, which lengthen a path.
"""
ROUGH_SHARE = 0.2
"""Additional standard error of a path's length, as a share of the length that the smoothing of its depths removed."""


@dataclass(frozen=True)
class SurfacePoint:
    """Surface point shown by a pixel."""

    pixel: tuple[float, float]
    """Column and row; the first pixel's centre is at (0.5, 0.5)."""
    position: tuple[float, float, float]
    """Position of the surface point in world coordinates."""
    depth: float
    """Depth of the point: z in camera coordinates, in the scene's unit."""
    depth_error: float
    """Standard error of `depth`, in its unit. The point is exactly on the pixel's ray."""
    source_error: float
    """Part of `depth_error` that comes from the depth source."""
    opacity: float
    confidence: float
    along_ray: tuple[float, float, float]
    """Derivative of the point's world position by its depth z, along the pixel's ray."""

    @property
    def position_error(self) -> float:
        """Standard error of the position along the ray, in the scene's unit."""
        return self.depth_error * math.hypot(*self.along_ray)


@dataclass(frozen=True)
class Length:
    """Length with its standard error, in the model's unit."""

    value: float
    error: float


class Measurement:
    """Surface of a model at one time and camera, for measurements.

    Raises:
        InvalidSetting: for a time outside the model's window.
    """

    def __init__(self, model: Model, time_s: float, camera: Camera | None = None) -> None:
        model.check_time(time_s)
        self.camera = camera or model.camera
        self.metric = model.metric
        self.origin = None if model.depth_source is None else model.depth_source.origin
        self._surface = _on_host(model.surface(time_s, self.camera))
        source = model.depth_source
        self._relative_error = UNKNOWN_ERROR if source is None else source.relative_error(time_s)
        pixels = self.camera.width_px * self.camera.height_px
        self._splat_px = math.sqrt(pixels / max(model.gaussians.count, 1))

    @property
    def unit(self) -> str:
        """`mm`, or `relative` if the model's scale is unknown."""
        return "mm" if self.metric else "relative"

    def point(self, x: float, y: float) -> SurfacePoint:
        """Return the surface point at the centre of the pixel that contains (x, y).

        Raises:
            InvalidSetting: outside the picture, or where no tissue was observed.
        """
        camera, surface = self.camera, self._surface
        if not (0 <= x < camera.width_px and 0 <= y < camera.height_px):
            raise InvalidSetting(f"({x:g}, {y:g}) is outside of the picture of {camera.width_px}x{camera.height_px} px")
        row, column = int(y), int(x)
        opacity, depth = float(surface["alpha"][row, column]), float(surface["ray_depth"][row, column])
        if opacity < COVERED or not depth > 0:
            raise InvalidSetting(
                f"nothing was observed at ({x:g}, {y:g}): the opacity there is {opacity:.2f}; measure where the model shows tissue"
            )
        start, step = rays_of(camera, np.array([column + 0.5, row + 0.5]))
        split, source = self._split(row, column), self._relative_error * depth
        return SurfacePoint(
            pixel=(column + 0.5, row + 0.5),
            position=_triple(in_world(start + step * depth, camera)),
            depth=depth,
            depth_error=math.hypot(split, source),
            source_error=source,
            opacity=opacity,
            confidence=float(surface["confidence"][row, column]),
            along_ray=_triple(step @ camera.world_to_camera[:3, :3]),
        )

    def distance(self, first: SurfacePoint, second: SurfacePoint) -> Length:
        """Return the straight distance between two points."""
        between = np.subtract(second.position, first.position)
        value = float(np.linalg.norm(between))
        return Length(value, _error_of_distance(first, second, between / value if value > 0 else np.zeros(3)))

    def length_along(self, first: SurfacePoint, second: SurfacePoint) -> Length:
        """Return the length along the surface under the straight line between two points in the picture.

        Depths along the line are smoothed before the length is computed, so that jitter of z does not lengthen the
        path. The error combines the error of the distance and a share of the length that smoothing removed.

        Raises:
            InvalidSetting: if any point of the path was not observed.
        """
        pixels = np.linspace(first.pixel, second.pixel, self._steps(first, second) + 1)
        depths = np.array([self.point(x, y).depth for x, y in pixels])
        apart_px = math.dist(first.pixel, second.pixel) / (len(pixels) - 1)
        smooth = _smoothed(depths, SMOOTHED_SPLATS * self._splat_px / max(apart_px, 1e-9))
        starts, steps = rays_of(self.camera, pixels)
        value, rough = (_length(starts + steps * each[:, None]) for each in (smooth, depths))
        ends = self.distance(first, second)
        detour = max(1.0, value / ends.value) if ends.value > 0 else 1.0
        return Length(value, math.hypot(ends.error * detour, ROUGH_SHARE * max(0.0, rough - value)))

    def _steps(self, first: SurfacePoint, second: SurfacePoint) -> int:
        return min(MOST_STEPS, max(1, round(math.dist(first.pixel, second.pixel) / STEP_PX)))

    def _split(self, row: int, column: int) -> float:
        """Return the difference between the mean and the median depth of a pixel. It is large where a pixel shows several
        surfaces. A pixel so transparent that it has no median depth gets its spread of depths.
        """
        mean, median = (float(self._surface[name][row, column]) for name in ("ray_depth", "median_depth"))
        return abs(mean - median) if median > 0 else float(self._surface["spread"][row, column])


def _error_of_distance(first: SurfacePoint, second: SurfacePoint, direction: NDArray[np.floating]) -> float:
    """Return the first-order error from both points' errors along their rays. Errors across the
    rays are of second order.
    """
    along = [abs(float(np.dot(point.along_ray, direction))) for point in (first, second)]
    length = float(np.linalg.norm(np.subtract(second.position, first.position)))
    scale = 0.5 * (first.source_error / first.depth + second.source_error / second.depth)
    own = [math.sqrt(max(0.0, point.depth_error**2 - COMMON * point.source_error**2)) for point in (first, second)]
    return math.hypot(own[0] * along[0], own[1] * along[1], math.sqrt(COMMON) * scale * length)


def _smoothed(depths: NDArray[np.floating], sigma: float) -> NDArray[np.floating]:
    """Smooth depths [N] along a path by a Gaussian of standard deviation `sigma` in steps. Constant slopes are kept, and
    the path is continued beyond its ends by point reflection, which keeps the ends in place.
    """
    reach = min(math.ceil(3 * sigma), len(depths) - 1)
    if reach < 1:
        return depths
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    before, after = 2 * depths[0] - depths[reach:0:-1], 2 * depths[-1] - depths[-2 : -reach - 2 : -1]
    return np.convolve(np.concatenate([before, depths, after]), taps / taps.sum(), "valid")


def _length(places: NDArray[np.floating]) -> float:
    """Return the length of the path through places [N, 3]."""
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def _triple(values: NDArray[np.floating]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _on_host(surface: Surface) -> dict[str, NDArray[np.float32]]:
    return {name: HostCopy(plane).numpy() for name, plane in surface._asdict().items()}
