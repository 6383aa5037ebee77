"""Range sensors that count returns in bins of depth, without resolving both directions of a picture; their simulation.

A sensor sees the same pixels as a camera, but sums their returns: over each column, or over the picture. Three kinds differ in
what a bin measures (Z-Splat, Qu et al. 2024).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Integral
from typing import ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera

Form = Literal["column", "image"]


@dataclass(frozen=True)
class RangeSensor:
    """Range sensor with bins of equal width; subclasses define what a bin measures.

    Raises:
        InvalidSetting: for a value out of its range.
    """

    nearest: float
    """Depth or distance at the first bin's near edge, in the scene's unit."""
    farthest: float
    """Depth or distance at the last bin's far edge, in the scene's unit."""
    bins: int = 256
    form: Form = "column"
    """`column` for one histogram for each column of the picture, `image` for a single one."""

    name: ClassVar[str]
    """Name under which `SENSORS` registers the sensor."""

    def __post_init__(self) -> None:
        if not 0 <= self.nearest < self.farthest < math.inf:
            raise InvalidSetting(
                f"the sensor measures from {self.nearest} to {self.farthest}; give a range with 0 <= nearest < farthest"
            )
        if not isinstance(self.bins, Integral) or not 1 <= self.bins <= 65536:
            raise InvalidSetting(f"bins is {self.bins}; it must be a whole number from 1 to 65536")
        if self.form not in get_args(Form):
            raise InvalidSetting(f"form is {self.form!r}; choose {' or '.join(get_args(Form))}")

    @property
    def bin_width(self) -> float:
        """Width of a bin in the scene's unit."""
        return (self.farthest - self.nearest) / self.bins

    def factors(self, camera: Camera) -> NDArray[np.float32] | None:
        """Return the ratio of measured range to depth z for each pixel [H, W], 0 for pixels that the sensor does not see; None for 1
        everywhere.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class TimeOfFlight(RangeSensor):
    """Time-of-flight sensor: bins of the distance along the ray."""

    name = "time_of_flight"

    def factors(self, camera: Camera) -> NDArray[np.float32] | None:
        """Return the ratio of distance along the ray to depth z for each pixel [H, W]. Raises InvalidInput for a camera other than
        a pinhole.
        """
        if camera.model != "pinhole":
            raise InvalidInput(
                f"the sensor {self.name!r} is for pinhole cameras, this one is {camera.model}; use structured_light"
            )
        x = (np.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
        y = (np.arange(camera.height_px) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
        return np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)


@dataclass(frozen=True)
class StructuredLight(RangeSensor):
    """Structured-light sensor: bins of the depth z, as a rectified projector and camera measure it."""

    name = "structured_light"

    def factors(self, camera: Camera) -> NDArray[np.float32] | None:
        """Return None, because the sensor measures the depth z."""
        return None


@dataclass(frozen=True)
class OctLine(RangeSensor):
    """Optical coherence tomography along one row of the picture: a B-scan with an A-scan for each column."""

    row: float = 0.5
    """Vertical position of the scanned line, from 0 at the top of the picture to 1 at its bottom."""
    thickness_px: int = 1

    name = "oct_line"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.row <= 1 or self.thickness_px < 1:
            raise InvalidSetting(
                f"the line is at {self.row} with {self.thickness_px} px; it must be at 0 to 1 with at least 1 px"
            )

    def factors(self, camera: Camera) -> NDArray[np.float32] | None:
        """Return 1 in the measured row of the picture and 0 elsewhere, [H, W]."""
        factors = np.zeros((camera.height_px, camera.width_px), np.float32)
        first = round(self.row * camera.height_px - self.thickness_px / 2)
        first = min(max(first, 0), max(camera.height_px - self.thickness_px, 0))
        factors[first : first + self.thickness_px] = 1
        return factors


@dataclass(frozen=True)
class RangeScan:
    """Measurement of a range sensor, taken at the same time and from the same place as a frame.

    Raises:
        InvalidInput: for counts of another shape than the sensor's, or counts that are negative or not finite.
    """

    sensor: RangeSensor
    counts: NDArray[np.float32]
    """Number of detected returns in each bin, [columns of the picture, bins] or [1, bins], up to one factor for each row of the
    array.
    """

    def __post_init__(self) -> None:
        if self.counts.ndim != 2 or self.counts.shape[1] != self.sensor.bins:
            raise InvalidInput(
                f"the counts of a scan must be [columns, {self.sensor.bins}], got {list(self.counts.shape)}"
            )
        if self.sensor.form == "image" and len(self.counts) != 1:
            raise InvalidInput(f"a scan of form image has one row of counts, got {len(self.counts)}")
        wrong = int(np.count_nonzero(~((self.counts >= 0) & np.isfinite(self.counts))))
        if wrong:
            raise InvalidInput(
                f"{wrong} of {self.counts.size} counts of a scan are negative, NaN or infinite; give 0 where nothing was"
                " measured"
            )


def resized_scan(scan: RangeScan, width_px: int, scale: float) -> RangeScan:
    """Return a scan for a resized picture. Columns are averaged over the columns that each new one covers; the single
    histogram of a sensor of form `image` is unchanged.
    """
    sensor = scan.sensor
    if isinstance(sensor, OctLine):
        sensor = replace(sensor, thickness_px=max(1, round(sensor.thickness_px * scale)))
    if sensor.form == "image":
        return RangeScan(sensor, scan.counts)
    edges = np.linspace(0, len(scan.counts), width_px + 1)
    sums = np.concatenate([np.zeros((1, scan.counts.shape[1])), np.cumsum(scan.counts, 0, np.float64)])
    low = np.floor(edges).astype(int).clip(max=len(scan.counts) - 1)
    at_edges = sums[low] + (edges - low)[:, None] * (sums[low + 1] - sums[low])
    # Rounding can make a difference of the sums slightly negative.
    counts = np.diff(at_edges, axis=0).clip(min=0) / np.diff(edges)[:, None]
    return RangeScan(sensor, counts.astype(np.float32))


def simulate_scan(
    depth: NDArray[np.floating],
    camera: Camera,
    sensor: RangeSensor,
    random: np.random.Generator,
    *,
    photons: float = 1000.0,
    jitter_bins: float = 0.5,
    ambient: float = 0.0,
) -> RangeScan:
    """Simulate a sensor on a depth map, with Poisson noise.

    Args:
        depth: depth z [H, W]; 0 for pixels without return.
        camera: camera of the depth map.
        sensor: sensor.
        random: generator of the noise.
        photons: expected returns of a whole row of the scan; infinity for no noise.
        jitter_bins: standard deviation of the time response in bins.
        ambient: expected returns of ambient light per bin.

    Raises:
        InvalidInput: for a depth map of another size than the camera's, or a negative number of photons, bins or returns.
    """
    depth = np.asarray(depth)
    if depth.shape != (camera.height_px, camera.width_px):
        raise InvalidInput(
            f"the depth map is {list(depth.shape)}, the camera's picture {[camera.height_px, camera.width_px]}"
        )
    if not photons >= 0:
        raise InvalidInput(f"photons is {photons}; it must be 0 or more")
    for name, value in (("jitter_bins", jitter_bins), ("ambient", ambient)):
        if not 0 <= value < math.inf:
            raise InvalidInput(f"{name} is {value}; it must be 0 or more, and finite")
    factors = sensor.factors(camera)
    ranges = depth if factors is None else depth * factors
    at = np.floor((ranges - sensor.nearest) / sensor.bin_width)
    seen = (ranges > 0) & (at >= 0) & (at < sensor.bins)
    columns = np.broadcast_to(np.arange(camera.width_px), depth.shape)
    clean = np.zeros((camera.width_px, sensor.bins))
    np.add.at(clean, (columns[seen], at[seen].astype(np.int64)), 1)
    if sensor.form == "image":
        clean = clean.sum(0, keepdims=True)
    if jitter_bins > 0:
        reach = math.ceil(4 * jitter_bins)
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / jitter_bins) ** 2)
        kernel /= kernel.sum()
        clean = np.stack([np.convolve(row, kernel)[reach : reach + sensor.bins] for row in clean])
    if math.isinf(photons):
        return RangeScan(sensor, clean.astype(np.float32))
    total = clean.sum(1, keepdims=True)
    expected = photons * np.divide(clean, total, out=np.zeros_like(clean), where=total > 0) + ambient
    return RangeScan(sensor, random.poisson(expected).astype(np.float32))
