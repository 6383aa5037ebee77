"""Measure rendered depth at structure-from-motion points, for recordings without dense depth.

The points were triangulated from the same pictures, independently of the model. Each is compared only in frames that show it. Lengths are in the unit of the poses, after
one factor for the whole recording: the median of true over rendered depth.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.depth import flat_depths
from gsplat_core.io.files import read_regular
from gsplat_core.scene.cameras import Camera

Array = NDArray[np.float64]
NAMES = ("points", "obs_point", "obs_frame")
MOST_BYTES = 256 << 20
"""Largest size of the file and of its arrays together, in bytes."""


@dataclass(frozen=True)
class SparsePoints:
    """World points, and the frames that show them."""

    points: Array
    """Positions in world coordinates [P, 3]."""
    seen_point: NDArray[np.int64]
    """Point index of each sighting [S]."""
    seen_frame: NDArray[np.int64]
    """Frame number of each sighting [S]."""

    @classmethod
    def read(cls, path: str | Path) -> SparsePoints:
        """Read a `.npz` file with `points` [P, 3], `obs_point` [S] and `obs_frame` [S]. Raises InvalidInput if they are inconsistent."""
        try:
            points, point, frame = _arrays(read_regular(path, MOST_BYTES))
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            RuntimeError,
            EOFError,
            RecursionError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            said = error.strerror or error if isinstance(error, OSError) else error
            raise InvalidInput(
                f"{path} cannot be read: {said!s:.200}; give a .npz file with points, obs_point and obs_frame"
            ) from error
        if points.ndim != 2 or points.shape[1] != 3 or point.ndim != 1 or point.shape != frame.shape:
            raise InvalidInput(
                f"{path}: points must be [P, 3], obs_point and obs_frame [S]; got {list(points.shape)}, {list(point.shape)} and {list(frame.shape)}"
            )
        if points.dtype.kind not in "fiu" or point.dtype.kind not in "iu" or frame.dtype.kind not in "iu":
            raise InvalidInput(
                f"{path}: points must be numbers, obs_point and obs_frame integers; got {points.dtype}, {point.dtype} and {frame.dtype}"
            )
        if not np.isfinite(points).all():
            raise InvalidInput(f"{path}: points holds NaN or infinite values; leave these points out")
        if len(point) and not (point.min() >= 0 and point.max() < len(points)):
            raise InvalidInput(
                f"{path}: obs_point goes from {point.min()} to {point.max()}, and there are {len(points)} points"
            )
        return cls(points.astype(np.float64), point.astype(np.int64), frame.astype(np.int64))

    def seen_in(self, number: int, camera: Camera) -> tuple[Array, Array]:
        """Return the pixels [n, 2] (x, y) and depths z [n] of a frame's points."""
        world = self.points[self.seen_point[self.seen_frame == number]]
        seen = world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        seen = seen[seen[:, 2] > 0]
        pixels = seen[:, :2] / seen[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]
        inside = ((pixels >= 0) & (pixels < [camera.width_px, camera.height_px])).all(1)
        return pixels[inside], seen[inside, 2]


def _arrays(data: bytes) -> list[NDArray[Any]]:
    """Return the arrays points, obs_point and obs_frame of a `.npz` file. Raises ValueError for other contents."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = [f"{name}.npy" for name in NAMES]
        missing = [name for name in NAMES if f"{name}.npy" not in archive.namelist()]
        if missing:
            raise ValueError(f"it has no {', '.join(sorted(missing))}")
        if sum(archive.getinfo(name).file_size for name in names) > MOST_BYTES:
            raise ValueError(f"its arrays have more than {MOST_BYTES >> 20} MiB")
        return [np.load(io.BytesIO(archive.read(name)), allow_pickle=False) for name in names]


@dataclass(frozen=True)
class SparseDepthErrors:
    """Errors over all sightings with rendered depth."""

    median: float
    """Median relative error after multiplication by `scale`."""
    percentile_90: float
    """90th percentile of the relative error."""
    rank_correlation: float
    """Spearman's rank correlation of true and rendered depth; 0 for a plane."""
    scale: float
    """Median of true over rendered depth; the factor applied before errors are computed."""
    plane_median: float
    """Median error of each frame's best-fit plane (`FlatDepths.plane`); NaN where no frame has three sightings."""
    level_median: float
    """Median error of each frame's level plane (`FlatDepths.level`)."""
    covered: float
    """Share of the sightings with rendered depth; the others are not part of the errors."""
    sightings: int


class SparseDepthSums:
    """Accumulator of errors, one frame at a time."""

    def __init__(self, points: SparsePoints) -> None:
        self._points = points
        self._rendered: list[Array] = []
        self._true: list[Array] = []
        self._flat: list[Array] = []
        """Depths [2, n] of each frame's best-fit and level plane."""

    def add(self, number: int, depth: NDArray[np.float32], camera: Camera) -> None:
        """Compare depth z [H, W], 0 = unknown, of frame `number` with its points; `camera` has the frame's pose and this size."""
        if depth.shape != (camera.height_px, camera.width_px):
            raise InvalidInput(f"depth is {list(depth.shape)}, its camera {camera.width_px}x{camera.height_px}")
        pixels, true = self._points.seen_in(number, camera)
        column, row = pixels.astype(np.int64).T
        shown = depth[row, column].astype(np.float64)
        self._rendered.append(shown)
        self._true.append(true)
        known = np.isfinite(shown) & (shown > 0)
        rays = np.column_stack([(pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2], np.ones(len(true))])
        flat = flat_depths(rays[known], true[known])
        planes = np.full((2, len(true)), np.nan)
        if flat is not None:
            planes[:, known] = flat.plane, flat.level
        self._flat.append(planes)

    def errors(self) -> SparseDepthErrors | None:
        """Return the errors, or None if no sighting has rendered depth."""
        rendered, true = (np.concatenate(each) if each else np.zeros(0) for each in (self._rendered, self._true))
        known = np.isfinite(rendered) & (rendered > 0)
        if not known.any():
            return None
        found, expected = rendered[known], true[known]
        scale = float(np.median(expected / found))
        relative = np.abs(scale * found - expected) / expected
        plane, level = np.abs(np.concatenate(self._flat, axis=1)[:, known] - expected) / expected
        has_plane = np.isfinite(plane)
        median = lambda errors: float(np.median(errors[has_plane])) if has_plane.any() else math.nan
        return SparseDepthErrors(
            median=float(np.median(relative)),
            percentile_90=float(np.percentile(relative, 90)),
            rank_correlation=_rank_correlation(found, expected),
            scale=scale,
            plane_median=median(plane),
            level_median=median(level),
            covered=float(known.mean()),
            sightings=len(true),
        )


def _rank_correlation(first: Array, second: Array) -> float:
    """Return Spearman's rank correlation with mean ranks for ties; 0 if either input is constant."""
    ranks = [_ranks(each) for each in (first, second)]
    if min(float(np.ptp(each)) for each in ranks) == 0:
        return 0.0
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def _ranks(values: Array) -> Array:
    _, group, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return np.asarray((last - (counts - 1) / 2)[group])
