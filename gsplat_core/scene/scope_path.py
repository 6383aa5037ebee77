"""Trajectory of the scope's left eye, and thereby of its light, during training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput

MOST_TIMES = 24
"""Maximum number of stored times, spread evenly over the training window."""


@dataclass(frozen=True, eq=False)
class ScopePath:
    """Poses of the left eye at some times.

    Raises:
        InvalidInput: if times do not increase, or the number of poses differs.
    """

    times_s: tuple[float, ...]
    world_to_camera: NDArray[np.float64]
    """World-to-camera [T, 4, 4]; [1, 4, 4] for a static scope."""

    def __post_init__(self) -> None:
        poses = np.array(self.world_to_camera, np.float64)
        count = len(self.times_s)
        if not 1 <= count <= MOST_TIMES or any(not before < after for before, after in pairwise(self.times_s)):
            raise InvalidInput(
                f"a scope's path has 1 to {MOST_TIMES} times that increase, got {list(self.times_s)!s:.80}"
            )
        if poses.shape not in ((count, 4, 4), (1, 4, 4)) or not np.isfinite(poses).all():
            raise InvalidInput(
                f"a scope's path of {count} times has as many poses [4, 4], or one, got {list(poses.shape)}"
            )
        poses.setflags(write=False)
        object.__setattr__(self, "world_to_camera", poses)

    @classmethod
    def of(cls, times_s: Sequence[float], poses: Sequence[NDArray[np.float64]]) -> ScopePath:
        """Subsample a sequence of poses; of several frames with the same time the last
        one is used.
        """
        last = dict(zip(times_s, poses, strict=True))
        times = list(last)
        kept = [times[k] for k in np.unique(np.linspace(0, len(times) - 1, MOST_TIMES).round().astype(int))]
        chosen = np.stack([last[time_s] for time_s in kept])
        still = bool((np.stack(poses) == chosen[0]).all())
        return cls(tuple(kept), chosen[:1] if still else chosen)

    def pose(self, number: int) -> NDArray[np.float64]:
        """Return the world-to-camera pose [4, 4] at the time with index `number`."""
        return np.asarray(self.world_to_camera[number % len(self.world_to_camera)])

    def centre_at(self, time_s: float) -> NDArray[np.float64]:
        """Return the position [3] of the eye at a time, interpolated linearly."""
        rotations, shifts = self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3]
        centres = -np.einsum("tji,tj->ti", rotations, shifts)
        if len(centres) == 1:
            return np.asarray(centres[0])
        return np.array([np.interp(time_s, self.times_s, axis) for axis in centres.T])

    def description(self) -> dict[str, Any]:
        """Return the path as JSON-serialisable values."""
        return {"times_s": list(self.times_s), "world_to_camera": self.world_to_camera.tolist()}
