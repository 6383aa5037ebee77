"""Errors of rendered depth, where a recording has measured depth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.depth_map import BELIEVED
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import ScoredMean


@dataclass(frozen=True)
class DepthErrors:
    """Means over frames of errors over the tissue pixels whose depth is known."""

    mae_mm: float
    """Mean absolute error."""
    rmse_mm: float
    """Root of the mean squared error."""
    relative: float
    """Mean absolute error divided by the true depth."""
    scaled_rmse_mm: float
    """`rmse_mm` after each frame's depth was multiplied by one factor, the median of true over rendered depth: of the shape alone."""
    covered: float
    """Share of these pixels at which the model has depth; the others are in no error."""
    frames: int


class DepthSums:
    """Takes frames one at a time; `errors` is what they come to."""

    def __init__(self) -> None:
        self._means = {name: ScoredMean() for name in ("mae_mm", "rmse_mm", "relative", "scaled_rmse_mm", "covered")}
        self._frames = 0

    def add(self, frame: Frame, depth: NDArray[np.float32]) -> float:
        """Compare depth z [H, W], 0 = unknown, with the frame's; returns the mean absolute error, NaN where nothing can be compared."""
        if frame.depth is None:
            return math.nan
        known = np.isfinite(frame.depth) & (frame.depth > 0)
        if frame.depth_confidence is not None:
            known &= frame.depth_confidence >= BELIEVED
        if frame.mask is not None:
            known &= frame.mask != 0
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
        """The means so far; None where no frame could be compared."""
        means = {name: mean.mean for name, mean in self._means.items()}
        found = {name: value for name, value in means.items() if value is not None}
        return DepthErrors(**found, frames=self._frames) if len(found) == len(means) else None
