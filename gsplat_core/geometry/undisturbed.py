"""The motion that tissue repeats, from the times and places at which nothing else moves it.

What a tool pulls is off from any periodic motion, and pulls a fit along with it, robust weights or not: points that are off by a little count nearly fully, and
where they are pulled nearer, all of the motion along the line of sight is wrong. Such points are off *together*, as errors of single points are not. So sightings whose
neighbours are off on average are left out, and the motion is fitted again to what is left.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.grid_tracks import GridTracks
from gsplat_core.geometry.periodic_motion import SPREAD_PX, Array, PeriodicMotion, fitted, off_px

AROUND_PX = 24.0
"""How far around a point its neighbours are (standard deviation)."""
CELL_PX = 4
"""Side of the cells in which they are gathered."""
FAR_OFF_PX = 8.0
"""Points that are off by more than that say little about their neighbours: they were not found, or are the tool's (Cauchy's scale)."""
LEAST_LEFT = 0.3
"""Share of a point's sightings that have to be left; with less of them all of them count."""
TIMES = 2
"""That it is fitted again."""


def fitted_undisturbed(tracks: GridTracks, motion: PeriodicMotion) -> PeriodicMotion:
    """`motion`, which was fitted to all of the tracks, fitted again to what nothing else moves."""
    for _ in range(TIMES):
        disturbed = together_px(off_px(motion.at(tracks.times_s), tracks), tracks) > SPREAD_PX
        left = tracks.seen & ~disturbed
        left = np.where(left.sum(0) >= LEAST_LEFT * tracks.seen.sum(0), left, tracks.seen)
        motion = fitted(replace(tracks, seen=left), motion.frequencies_hz, motion.terms[:, :, 0])
    return motion


def together_px(off: Array, tracks: GridTracks) -> Array:
    """Length [T, N] of the mean by which the points that are seen around each one are off, of what each is off [T, N, 2] in pixels."""
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
    """Sums of `values` [N] in cells, and around each."""
    sums = np.bincount(where, values, size[0] * size[1]).reshape(size)
    return np.asarray(cv2.GaussianBlur(sums, (0, 0), AROUND_PX / CELL_PX, borderType=cv2.BORDER_CONSTANT))
