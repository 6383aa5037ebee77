"""Points of a hilly sheet that breathes and beats, seen by a scope that sways; exact, without pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.grid_tracks import GridTracks

FOCAL_PX, EXTENT = 280.0, (0.57, 0.45)
BREATHING_HZ, HEART_HZ = 0.31, 1.2
DISTANCE = 70.0


def swaying(times_s: NDArray[np.float64], reach: float = 1.0) -> NDArray[np.float64]:
    """World to camera [T, 4, 4]: to and fro with three periods, and turned a little."""
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    for axis, (far, period_s) in enumerate(((7.0, 4.4), (5.0, 5.7), (6.0, 7.3))):
        poses[:, axis, 3] = -reach * far * np.sin(2 * np.pi * times_s / period_s)
    turn = 0.04 * np.sin(2 * np.pi * times_s / 5.1)
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = (
        np.cos(turn),
        np.sin(turn),
        -np.sin(turn),
        np.cos(turn),
    )
    return poses


def places(times_s: NDArray[np.float64], breathes: float = 1.0, count: int = 300) -> NDArray[np.float64]:
    """Return the positions of the points over time [T, N, 3]."""
    random = np.random.default_rng(5)
    x, y = random.uniform(-35, 35, count), random.uniform(-27, 27, count)
    z = DISTANCE + 4 * np.sin(x / 11) * np.cos(y / 9) + 0.1 * x
    breath = 2 * np.pi * BREATHING_HZ * times_s[:, None] + x / 24 + 0.4
    beat = 2 * np.pi * HEART_HZ * times_s[:, None] - y / 15
    moved = np.stack([1.5 * np.cos(breath), 0.3 * np.sin(beat), 2.3 * np.sin(breath) + 0.3 * np.cos(beat)], 2)
    return np.stack([x, y, z], 1) + breathes * moved


def tracks_of(
    points: NDArray[np.float64], poses: NDArray[np.float64], times_s: NDArray[np.float64], noise_px: float = 0.2
) -> GridTracks:
    """Return noisy tracks of points [T, N, 3]. One in eight sightings is missing."""
    random = np.random.default_rng(6)
    local = np.einsum("tij,tnj->tni", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    rays = local[..., :2] / local[..., 2:] + random.normal(0, noise_px / FOCAL_PX, (*points.shape[:2], 2))
    return GridTracks(rays, random.random(points.shape[:2]) > 0.125, poses, times_s, FOCAL_PX, EXTENT)
