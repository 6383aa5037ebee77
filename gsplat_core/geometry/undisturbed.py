"""Robust fit of periodic motion that excludes tissue disturbed by tools.

Tissue pulled by a tool biases a periodic fit even with robust weights, because small deviations
keep nearly full weight. A pull towards the camera then corrupts the motion along the line of sight.
Disturbed points deviate together, unlike points with independent errors. Observations whose
neighbours deviate on average are therefore excluded and the motion is fitted again.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.grid_tracks import GridTracks
from gsplat_core.geometry.periodic_motion import SPREAD_PX, Array, PeriodicMotion, fitted, off_px

AROUND_PX = 24.0
"""Standard deviation of a point's neighbourhood in pixels."""
CELL_PX = 4
"""Side of the cells in which deviations are accumulated, in pixels."""
FAR_OFF_PX = 8.0
"""Cauchy scale in pixels; points with larger errors are mistracked or on the tool and have little
weight for their neighbours.
"""
LEAST_LEFT = 0.3
"""Share of a point's observations that must remain; otherwise all of them are used."""
TIMES = 2
"""Number of refits."""


def fitted_undisturbed(tracks: GridTracks, motion: PeriodicMotion) -> PeriodicMotion:
    """Refit a motion without disturbed observations."""
    for _ in range(TIMES):
        disturbed = together_px(off_px(motion.at(tracks.times_s), tracks), tracks) > SPREAD_PX
        left = tracks.seen & ~disturbed
        left = np.where(left.sum(0) >= LEAST_LEFT * tracks.seen.sum(0), left, tracks.seen)
        motion = fitted(replace(tracks, seen=left), motion.frequencies_hz, motion.terms[:, :, 0])
    return motion


def together_px(off: Array, tracks: GridTracks) -> Array:
    """Return the length of the locally averaged error around each observation.

    Args:
        off: errors in pixels [T, N, 2].
        tracks: observations.

    Returns:
        Lengths in pixels [T, N].
    """
    half = np.array(tracks.extent) * tracks.focal_px
    columns, rows = np.ceil(2 * half / CELL_PX).astype(int)
    cells = np.clip(((tracks.rays * tracks.focal_px + half) / CELL_PX).astype(int), 0, [columns - 1, rows - 1])
    index = cells[..., 1] * columns + cells[..., 0]
    weight = tracks.seen / (1 + (off**2).sum(2) / FAR_OFF_PX**2)
    found = np.zeros(index.shape)
    for picture, where in enumerate(index):
        sums = [_gathered(weight[picture] * each, where, (rows, columns)) for each in (1.0, *off[picture].T)]
        mean = np.stack(sums[1:]) / np.maximum(sums[0], 1e-9)
        found[picture] = np.hypot(*mean.reshape(2, -1)[:, where])
    return found


def _gathered(values: Array, where: NDArray[np.integer], size: tuple[int, int]) -> Array:
    """Return sums of `values` [N] over cells, blurred by the neighbourhood."""
    sums = np.bincount(where, values, size[0] * size[1]).reshape(size)
    return np.asarray(cv2.GaussianBlur(sums, (0, 0), AROUND_PX / CELL_PX, borderType=cv2.BORDER_CONSTANT))
