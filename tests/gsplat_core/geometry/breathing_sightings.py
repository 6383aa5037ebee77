"""Exact point observations of a breathing sheet by a swaying scope, and the poses estimated from them for static tissue."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.poses.breathing import Sightings
from gsplat_core.poses.moving_bundle import MovingBundle, SurfaceField
from tests.gsplat_core.geometry.breathing_points import DISTANCE, places, swaying, tracks_of


def seen_for(
    length_s: float,
    breathes: float = 1.0,
    rate_hz: float = 10.0,
    noise_px: float = 0.2,
    pulled: int = 0,
    points: int = 300,
) -> tuple[Sightings, NDArray[np.float64]]:
    """Return the observations of a number of points and the true poses. `pulled` points have irregular motion of their own."""
    times_s = np.arange(0, length_s, 1 / rate_hz)
    poses, at = swaying(times_s), places(times_s, breathes, points)
    at[:, :pulled] += 6 * np.clip(np.sin(times_s**1.7), 0, 1)[:, None, None] * np.array([0.5, 0.3, -0.8])
    tracks = tracks_of(at, poses, times_s, noise_px)
    frame, point = np.nonzero(tracks.seen)
    taken = np.stack([pose @ rigid(at[0], each) for pose, each in zip(poses, at, strict=True)])
    taken[:, :3, 3] /= DISTANCE
    sightings = Sightings(
        torch.from_numpy(frame), torch.from_numpy(point), torch.from_numpy(tracks.rays[frame, point]),
        torch.from_numpy(times_s), torch.from_numpy(taken), torch.from_numpy(at[0] / DISTANCE),
    )  # fmt: skip
    return sightings, poses


def rigid(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rigid motion [4, 4] that brings points nearest to others [N, 3]: of tissue, what is taken for the scope's."""
    a, b = first - first.mean(0), second - second.mean(0)
    u, _, vt = np.linalg.svd(b.T @ a)
    motion = np.eye(4)
    motion[:3, :3] = (u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    motion[:3, 3] = second.mean(0) - motion[:3, :3] @ first.mean(0)
    return motion


def bundle_of(sightings: Sightings, waves: torch.Tensor, most_nodes: int = 30) -> MovingBundle:
    """Return one bundle of all sightings, without motion."""
    field = SurfaceField.over(sightings.points, most_nodes)
    amplitudes = torch.zeros(len(field.nodes), 3, waves.shape[1], dtype=torch.float64)
    influence = field.influence(sightings.points)
    return MovingBundle(
        sightings.poses,
        sightings.points,
        amplitudes,
        sightings.frame,
        sightings.point,
        sightings.rays,
        waves,
        influence,
        field,
    )
