"""Measurement of points, distances and lengths on a model's surface, each with a standard error.

The standard error of a point has three parts that are treated as independent: the spread of z along
the ray (`Surface.spread`), the depth ambiguity of partly transparent pixels, and the error of the
depth source used in training (`DepthOrigin.relative_error`). The last part is largely common to the whole scene.
Treating it as independent between two points overestimates the error. The camera is assumed exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.surface import in_world, rays_of
from gsplat_core.models.model import Model
from gsplat_core.rendering.surface import COVERED, Surface
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_origin import UNKNOWN_ERROR
from gsplat_core.transfers import HostCopy

MOST_STEPS = 4096
"""Largest number of steps of a length along the surface."""


@dataclass(frozen=True)
class SurfacePoint:
    """Surface point shown by a pixel."""

    pixel: tuple[float, float]
    """Column and row; the first pixel's centre is at (0.5, 0.5)."""
    position: tuple[float, float, float]
    """Position of the surface point in world coordinates."""
    depth: float
    """z in camera coordinates."""
    depth_error: float
    """Standard error of z. The point is exactly on the pixel's ray."""
    opacity: float
    confidence: float
    along_ray: tuple[float, float, float]
    """Derivative of the world position by z."""

    @property
    def position_error(self) -> float:
        """Standard error of the position along the ray."""
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
        spread = float(surface["spread"][row, column])
        # In half-transparent pixels the median depth is as plausible as the mean, so their difference adds to the
        # error.
        median = float(surface["median_depth"][row, column])
        split = abs(depth - median) if median > 0 else spread
        relative_error = UNKNOWN_ERROR if self.origin is None else self.origin.relative_error
        error = math.hypot(spread, (1 - opacity) * depth, split, relative_error * depth)
        return SurfacePoint(
            pixel=(column + 0.5, row + 0.5),
            position=_triple(in_world(start + step * depth, camera)),
            depth=depth,
            depth_error=error,
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

        Steps are two pixels long, about the detail of the splats, so that jitter of z does not lengthen the path. The
        error combines the errors of both ends and the jitter.

        Raises:
            InvalidSetting: if any point of the path was not observed.
        """
        (x0, y0), (x1, y1) = first.pixel, second.pixel
        steps = min(MOST_STEPS, max(1, round(math.hypot(x1 - x0, y1 - y0) / 2)))
        at = [self.point(x0 + (x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps) for k in range(steps + 1)]
        places = np.array([each.position for each in at])
        value = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
        ends = self.distance(first, second)
        jitter = _roughness(places)
        return Length(value, math.hypot(ends.error, jitter))


def _error_of_distance(first: SurfacePoint, second: SurfacePoint, direction: NDArray[np.floating]) -> float:
    """Return the first-order error from both points' errors along their rays. Errors across the
    rays are of second order.
    """
    parts = [point.depth_error * abs(float(np.dot(point.along_ray, direction))) for point in (first, second)]
    # Both depths may share one scale error, which changes distances across the rays by the same
    # factor.
    across = 0.5 * (first.depth_error / first.depth + second.depth_error / second.depth)
    length = float(np.linalg.norm(np.subtract(second.position, first.position)))
    return math.hypot(*parts, across * length)


def _roughness(places: NDArray[np.floating]) -> float:
    """Return the difference in length between the path through all points and the path through every other point."""
    if len(places) < 3:
        return 0.0
    fine = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    coarse = [*places[:-1:2], places[-1]]
    return max(0.0, fine - float(np.linalg.norm(np.diff(np.array(coarse), axis=0), axis=1).sum()))


def _triple(values: NDArray[np.floating]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _on_host(surface: Surface) -> dict[str, NDArray[np.float32]]:
    return {name: HostCopy(plane).numpy() for name, plane in surface._asdict().items()}
