"""Places that a scope comes back to, found by its poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput

NEAR_SHARE = 0.05
"""Two positions are one place when they are nearer than this share of the greatest distance between any two; a scale need not be known."""
NEAR_DEGREES = 10.0
AWAY = 3.0
"""In between, the scope must have been this many times as far away, or turned as much."""
MAX_POSES = 2048
"""Poses that are kept; of a longer stream every second, fourth, ... one is."""

Range = tuple[float, float]
"""First and last time, in seconds."""


@dataclass(frozen=True)
class Visits:
    """Two stays at one place."""

    first: Range
    again: Range

    def __post_init__(self) -> None:
        if not self.first[0] <= self.first[1] < self.again[0] <= self.again[1]:
            raise InvalidInput(f"visits {self.first} and {self.again} must be two ranges of time, one after the other")


class PlaceFinder:
    """Takes the pose of each frame; `visits` are the returns. Memory of fixed size."""

    def __init__(self) -> None:
        self._poses: list[tuple[float, NDArray[np.float64]]] = []
        self._every = 1
        self._seen = 0

    def add(self, time_s: float, world_to_camera: NDArray[np.float64]) -> None:
        """The next frame's pose [4, 4]."""
        if self._seen % self._every == 0:
            self._poses.append((time_s, np.asarray(world_to_camera, np.float64)))
            if len(self._poses) == MAX_POSES:
                self._poses = self._poses[::2]
                self._every *= 2
        self._seen += 1

    def visits(self) -> list[Visits]:
        """Each return to a place that the scope had left, with the last stay there before it."""
        if len(self._poses) < 3:
            return []
        times = [time_s for time_s, _ in self._poses]
        apart = _distances(np.stack([pose for _, pose in self._poses]))
        found: list[Visits] = []
        k = 0
        while k < len(times):
            j = _last_stay(apart[k, :k])
            if j is None:
                k += 1
                continue
            begin = j
            while begin > 0 and apart[k, begin - 1] <= 1:
                begin -= 1
            end = k
            while end + 1 < len(times) and apart[j, end + 1] <= 1:
                end += 1
            found.append(Visits((times[begin], times[j]), (times[k], times[end])))
            k = end + 1
        return found


def _last_stay(apart: NDArray[np.float64]) -> int | None:
    """The newest earlier moment at the same place from which the scope has been away since; None where there is none."""
    away = np.flatnonzero(apart >= AWAY)
    if not len(away):
        return None
    near = np.flatnonzero(apart[: away[-1]] <= 1)
    return int(near[-1]) if len(near) else None


def _distances(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far apart each two poses [K, 4, 4] are [K, K], where 1 is the edge of "the same place": the larger of position and direction."""
    rotations, translations = poses[:, :3, :3], poses[:, :3, 3]
    centres = -np.einsum("kij,ki->kj", rotations, translations)
    between = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    largest = float(between.max())
    axes = rotations[:, 2]  # the third row is the viewing direction in the world
    degrees = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    position = between / (NEAR_SHARE * largest) if largest > 0 else np.zeros_like(between)
    return np.maximum(position, degrees / NEAR_DEGREES)
