"""Errors of a model's depth over a whole sequence, as a share of the typical depth, beside the level plane and the best-fit plane of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.plane import flat_depths, pixels_to_compare
from gsplat_core.scene.cameras import Camera

MOST_PIXELS = 8192
"""Pixels of a frame that are compared, spread evenly: what is kept does not grow with the pictures."""


@dataclass(frozen=True)
class DepthShare:
    """Errors over all compared pixels of all compared frames: tissue, with known depth, at which the model has depth."""

    rmse_share: float
    """Root of the mean squared error, divided by the median true depth."""
    scaled_rmse_share: float
    """The same after the model's depth was multiplied by `scale`: of the shape alone."""
    plane_rmse_share: float
    """Error of each frame's best-fit plane (`FlatDepths.plane`), which is fitted to the truth."""
    level_rmse_share: float
    """Error of each frame's level plane (`FlatDepths.level`), which is fitted to the truth."""
    median_share: float
    """Median of the absolute error after `scale`, divided by the true depth."""
    rmse: float
    """`rmse_share` in the unit of the recording's depth."""
    scale: float
    """One factor for the whole sequence: the median of true depth over the model's."""
    median_depth: float
    covered: float
    """Share of the pixels of tissue with known depth at which the model has depth."""
    frames: int


class DepthShareSums:
    """Takes frames one at a time; keeps at most `MOST_PIXELS` of each."""

    def __init__(self) -> None:
        self._kept: list[NDArray[np.float64]] = []
        self._known = self._both = 0

    def add(self, camera: Camera, true: NDArray[Any], shown: NDArray[Any], known: NDArray[np.bool_]) -> None:
        """Compare depth z [H, W] that a model shows, 0 = nothing there, with the true one where that is known."""
        both = known & np.isfinite(shown) & (shown > 0)
        self._known += int(known.sum())
        self._both += int(both.sum())
        rays, *values = pixels_to_compare(camera, both, MOST_PIXELS, true, shown)
        flat = flat_depths(rays, values[0])
        if flat is not None:
            self._kept.append(np.stack([*values, flat.plane, flat.level]))

    @property
    def errors(self) -> DepthShare | None:
        """What they come to; None where nothing could be compared."""
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
