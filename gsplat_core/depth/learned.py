"""Relative depth by a monocular network supplied by the user as an ONNX model.

Monocular networks predict depth or inverse depth up to a scale and offset that differ for each picture. An affine fit
aligns the output with a reference: the frame's own depth if it has one, otherwise the previous result, which avoids
flicker. The first frame of a stream without depth gets an assumed alignment.

The alignment functions take values that are either depth or inverse depth. Their result is of the same kind.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.depth.maps import DepthMap, Estimator, doubted
from gsplat_core.endoscope.onnx import Finite, OnnxNetwork, PictureSettings, Positive
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, LEARNED, RELATIVE_DISTANCE, Frame

Plane = NDArray[np.float64]
MOST_SPAN = 5.0
"""Largest assumed ratio of the far end of a picture to its near end, used when no reference depth determines the offset
of the network's output.
"""
ENDS = (2.0, 98.0)
"""Percentiles of a picture's values that are used as its near and far end; values beyond them may be outliers."""
ROUNDS = 10
LEAST_VALUES = 64
CONSTANT = 1e-4
"""Ratio of the spread of a network's output to its magnitude below which the output counts as constant, without relief."""


class Affine(NamedTuple):
    """Affine map `factor` · values + `summand` from a network's output to reference values."""

    factor: float
    summand: float
    alike: float
    """Weighted correlation of network output and reference depth, -1 to 1. It has the sign of the fitted scale."""

    def of(self, values: Plane) -> Plane:
        """Return `factor` · `values` + `summand` for values of any shape."""
        return self.factor * values + self.summand


def is_constant(values: Plane) -> bool:
    """Return True if values [N] are constant except for noise (`CONSTANT`)."""
    low, high = np.percentile(values, ENDS)
    return bool(high - low <= CONSTANT * max(abs(low), abs(high), 1e-30))


def with_assumed_zero(values: Plane) -> Affine:
    """Return the map whose offset limits the ratio of far to near values [N] to `MOST_SPAN`; zero offset if already
    smaller.

    Used when no reference depth is available.
    """
    low, high = np.percentile(values, ENDS)
    missing = (high - MOST_SPAN * low) / (MOST_SPAN - 1)
    return Affine(1.0, max(0.0, float(missing)), 1.0)


def fitted(values: Plane, known: Plane) -> Affine | None:
    """Fit the affine map from `values` [N] to `known` [N] robustly.

    Both sides have errors, so their spreads are made equal (reduced major axis regression). Least squares would flatten
    the relief a little at each fit, and depth that is fitted to the previous frame's depth would become flat over time.
    Outliers are suppressed by iteratively reweighted estimates with Cauchy weights.

    Args:
        values: float64 [N], the network's output.
        known: float64 [N], reference values at the same pixels.

    Returns:
        The map, or None for fewer than `LEAST_VALUES` values or when either side is constant.
    """
    if len(values) < LEAST_VALUES or is_constant(values) or is_constant(known):
        return None
    rising, falling = (_by_medians(values, known, sign) for sign in (1.0, -1.0))
    found = min(rising, falling, key=lambda each: float(np.median(np.abs(each.of(values) - known))))
    sign = np.sign(found.factor)
    for _ in range(ROUNDS):
        off = np.abs(found.of(values) - known)
        typical = max(1.4826 * float(np.median(off)), 1e-9 * float(np.abs(known).max()))
        weights = 1 / (1 + (off / (2 * typical)) ** 2)
        (x, dx), (y, dy) = _spread(values, weights), _spread(known, weights)
        if dx <= 0 or dy <= 0:
            return None
        factor = float(sign * dy / dx)
        found = Affine(factor, y - factor * x, _correlation(values, known, weights))
    return found


def _by_medians(values: Plane, known: Plane, sign: float) -> Affine:
    """Return a start value of the affine fit, computed from medians and therefore robust to outliers.

    Args:
        values: values of the depth network, in any scale.
        known: reference depth at the same pixels.
        sign: sign of the fitted factor, 1 or -1.
    """
    (x, dx), (y, dy) = _middle(values), _middle(known)
    factor = sign * dy / dx
    return Affine(factor, y - factor * x, 0.0)


def _middle(values: Plane) -> tuple[float, float]:
    """Return the median of values and their median absolute deviation, or their standard deviation if that is zero."""
    median = float(np.median(values))
    return median, float(np.median(np.abs(values - median))) or float(values.std())


def _spread(values: Plane, weights: Plane) -> tuple[float, float]:
    mean = float(np.average(values, weights=weights))
    return mean, float(np.sqrt(np.average((values - mean) ** 2, weights=weights)))


def _correlation(x: Plane, y: Plane, weights: Plane) -> float:
    (mean_x, dx), (mean_y, dy) = _spread(x, weights), _spread(y, weights)
    together = float(np.average((x - mean_x) * (y - mean_y), weights=weights))
    return together / (dx * dy) if dx > 0 and dy > 0 else 0.0


Values = Literal["inverse", "depth"]
VALUES_IN_ADDRESS = "?values="
MULTIPLES_PX = (14, 32)
"""Granularity of the input size for networks that accept any size. The first one that works is
used; vision transformers have patches of 14 pixels.
"""
SMALLEST_PX = 4
GRID_PX = 80
"""Longer side of the grid on which network outputs are compared, in cells."""
EVERY_S = 0.3
"""Time from one inference to the next in seconds. The previous result is reused in between unless the scope moves."""
ALIKE = 0.6
"""Smallest correlation of a network's output with a reference depth at which both count as showing the same scene."""
LEAST_SEEN = 0.05
"""Share of the picture that must be visible tissue; with less, the network's depth is rejected."""
UNSEEN = "too little of the picture is tissue for a depth network"
NOT_FINITE = "the depth network gave values that are not finite"
FLAT = "the depth network returned the same depth for the whole picture"
AGAINST = "the depth network's output is inverted relative to the frame's own depth; use the other one of values=depth and values=inverse"
UNLIKE = "the depth network's output does not correlate with the frame's own depth"
GIVEN = "the depth network's output was scaled to the frames' own depth"


class DepthSettings(PictureSettings):
    """Settings of a depth network that cannot be derived from its tensor shapes."""

    mean: tuple[Finite, Finite, Finite] = (0.485, 0.456, 0.406)
    std: tuple[Positive, Positive, Positive] = (0.229, 0.224, 0.225)
    values: Values = "inverse"
    """Kind of the output: depth along the optical axis, or its inverse."""


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        about = path.stat()
    except OSError:  # the loader reports a missing file
        return None
    return about.st_mtime_ns, about.st_size


@lru_cache(maxsize=1)
def _network(path: Path, stamps: tuple[tuple[int, int] | None, ...]) -> OnnxNetwork[DepthSettings]:
    """Load a depth network and run it once as a test; cached for all streams. `stamps` are the files' modification
    times and sizes, so a changed file is reloaded.
    """
    network = OnnxNetwork(path, "depth network", DepthSettings, multiple_px=MULTIPLES_PX[0])
    noise = np.random.default_rng(0).integers(0, 256, (256, 320, 3), np.uint8)
    try:
        output = network.run(noise)
    except InvalidSetting:
        network.multiple_px = MULTIPLES_PX[1]
        output = network.run(noise)
    shape = output.shape
    fits = len(shape) in (3, 4) and set(shape[:-2]) == {1} and SMALLEST_PX <= min(shape[-2:]) <= max(shape) <= 4096
    if not fits or not np.issubdtype(output.dtype, np.floating):
        raise network.refused(f"gives {output.dtype} {list(shape)}; it must give floats [1, h, w] or [1, 1, h, w]")
    return network


class LearnedDepth(Estimator):
    """Depth estimator of one stream that runs a network at intervals and keeps its scale steady.
    The depth is never metric.
    """

    origin = LEARNED
    evidence = "answers of the depth network"

    def __init__(self, address: str) -> None:
        """Load the depth network.

        Args:
            address: path of the model. A suffix `?values=depth` or `?values=inverse` overrides the model's own setting.

        Raises:
            InvalidSetting: for a network that cannot be used.
        """
        name, found, values = address.rpartition(VALUES_IN_ADDRESS)
        if found and values not in get_args(Values):
            raise InvalidSetting(
                f"depth 'onnx:{address}' has values {values!r}; choose {' or '.join(get_args(Values))}"
            )
        path = Path(name if found else address)
        self._network = _network(path, (_stamp(path), _stamp(path.with_name(path.name + ".json"))))
        self._inverse = (values if found else self._network.settings.values) == "inverse"
        self._forget()

    def _forget(self) -> None:
        self._estimated_ns: int | None = None
        self._answer: DepthMap | None = None
        self._before: NDArray[np.float64] | None = None
        """Last usable result on the comparison grid, as depth or inverse depth like the network's output. The next
        output is aligned to it in scale and offset.
        """
        self._pose: NDArray[np.float64] | None = None

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """Return the depth of a frame from a new inference. Within `EVERY_S` of the last inference, return its result if the
        scope has not moved, otherwise None.

        Raises:
            InvalidSetting: if the network fails on a picture.
        """
        if frame.new_scene is not None or self._resized(frame):
            self._forget()
        if self._estimated_ns is not None and 0 <= frame.pts_ns - self._estimated_ns < EVERY_S * 1e9:
            stands_still = self._pose is not None and np.array_equal(self._pose, camera.world_to_camera)
            return self._answer if stands_still else None
        self._answer = self._estimated(frame)
        self._estimated_ns, self._pose = frame.pts_ns, camera.world_to_camera.copy()
        return self._answer

    def _resized(self, frame: Frame) -> bool:
        return self._answer is not None and self._answer.depth.shape != frame.image.shape[:2]

    def _estimated(self, frame: Frame) -> DepthMap:
        size = frame.height_px, frame.width_px
        output = self._network.run(frame.image)
        values = np.asarray(output.reshape(output.shape[-2:]), np.float32)
        if not np.isfinite(values).all():
            return doubted(size, LEARNED, NOT_FINITE)
        grid, seen = _on_grid(values, size, cv2.INTER_AREA), _on_grid(_tissue(frame), size) > 0
        if seen.mean() < LEAST_SEEN:
            return doubted(size, LEARNED, UNSEEN)
        if is_constant(grid[seen]):
            return doubted(size, LEARNED, FLAT)
        solved = self._by_given(grid, seen, frame)
        if isinstance(solved, str):
            return doubted(size, LEARNED, solved)
        remark = None if solved is None else GIVEN
        solved = solved or self._by_before(grid, seen) or self._assumed(grid[seen])
        self._before = solved.of(grid)
        low, middle = np.percentile(self._before[seen], (ENDS[0], 50))
        least = max(low / 2, middle / MOST_SPAN**2)
        large = cv2.resize(values, (size[1], size[0]), interpolation=cv2.INTER_LINEAR).astype(np.float64)
        found = solved.of(large)
        depth = self._kind(np.maximum(found, least)).astype(np.float32)
        # A network gives no estimate of its error, so the confidence is everywhere the smallest at which depth is used.
        return DepthMap(
            depth,
            np.where(found > least, BELIEVED, 0).astype(np.float32),
            LEARNED,
            metric=False,
            remark=remark,
        )

    def _kind(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert depth to the kind of values that the network returns (depth or inverse depth), or back."""
        return 1 / values if self._inverse else values

    def _by_given(self, grid: NDArray[np.float64], seen: NDArray[np.bool_], frame: Frame) -> Affine | str | None:
        """Return the map that aligns the network's output to the frame's own depth. None if that depth covers too little, or a
        rejection reason if the two do not correlate.
        """
        if frame.depth is None:
            return None
        depth = frame.depth
        if frame.depth_confidence is not None:
            depth = np.where(frame.depth_confidence >= BELIEVED, depth, 0)
        given = _on_grid(depth, (frame.height_px, frame.width_px))
        both = seen & (given > 0)
        found = fitted(grid[both], self._kind(given[both]))
        if found is None or found.alike >= ALIKE:
            return found
        return AGAINST if found.alike <= -ALIKE else UNLIKE

    def _by_before(self, grid: NDArray[np.float64], seen: NDArray[np.bool_]) -> Affine | None:
        """Return the map that aligns the network's output to the previous result. None without one, or if it shows another scene."""
        if self._before is None:
            return None
        found = fitted(grid[seen], self._before[seen])
        return found if found is not None and found.alike >= ALIKE else None

    def _assumed(self, values: NDArray[np.float64]) -> Affine:
        """Return the map with the offset of `with_assumed_zero` that gives the geometric mean depth `RELATIVE_DISTANCE`."""
        zero = with_assumed_zero(values)
        positive = np.clip(zero.of(values), *np.percentile(zero.of(values), ENDS))
        factor = self._kind(np.array(RELATIVE_DISTANCE)) / np.exp(np.log(positive).mean())
        return Affine(float(factor), float(factor) * zero.summand, 1.0)


def _tissue(frame: Frame) -> NDArray[np.uint8]:
    """Return a mask uint8 [H, W], 0 for tools and pixels outside the field of view."""
    masks = [mask for mask in (frame.mask, frame.loss_mask) if mask is not None]
    whole = np.ones((frame.height_px, frame.width_px), np.bool_)
    return np.logical_and.reduce([whole, *masks]).astype(np.uint8)


def _on_grid(plane: NDArray[np.generic], size: tuple[int, int], how: int = cv2.INTER_NEAREST) -> NDArray[np.float64]:
    """Resample a plane that covers a picture of `size` (height, width) to the grid on which network outputs are compared."""
    scale = GRID_PX / max(size)
    columns, rows = (max(1, round(side * scale)) for side in (size[1], size[0]))
    return np.asarray(cv2.resize(np.asarray(plane, np.float32), (columns, rows), interpolation=how), np.float64)
