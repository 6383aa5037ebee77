"""Capacity of a frame's tile lists, and detection of frames that exceed it.

An instance is a pair of a splat and a tile that it touches. A tile's list holds the instances that
it blends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.frame.frame import (
    MAX_SEGMENT,
    STATUS_LONGEST,
    STATUS_NEEDED,
    STATUS_OVERFLOW,
    TILE_SIZE,
    FrameMode,
)

CAPACITY_STEP = 1 << 16
"""Granularity in instances of the capacity of a shared buffer."""
TILE_STEP = 32
"""Granularity in instances of the capacity of each tile's buffer."""
HEADROOM = 1.25
"""Capacity relative to a frame's need, so that a moving scene seldom exceeds it."""


def capacity_for(needed: int) -> int:
    """Return the shared capacity to allocate after a frame that needed `needed` instances."""
    return max(1, math.ceil(needed * HEADROOM / CAPACITY_STEP)) * CAPACITY_STEP


@dataclass(frozen=True)
class TileListCapacity:
    """Capacity of a buffer shared by all tile lists, or of each tile's own segment."""

    capacity: int
    per_tile: bool

    @property
    def mode(self) -> FrameMode:
        """Mode of `render_frame` for this capacity."""
        return FrameMode.SEGMENTS if self.per_tile else FrameMode.SHARED

    @staticmethod
    def for_frame(needed: int, most_in_tile: int) -> TileListCapacity:
        """Return the capacity for a frame's measured need.

        Separate buffers per tile are faster and take up to 32 bytes per pixel. If a tile has more
        instances than fit, one shared buffer is used.

        Args:
            needed: number of instances in the frame.
            most_in_tile: largest number of instances in one tile.
        """
        of_tile = max(1, math.ceil(most_in_tile * HEADROOM / TILE_STEP)) * TILE_STEP
        if of_tile <= MAX_SEGMENT:
            return TileListCapacity(of_tile, per_tile=True)
        return TileListCapacity(capacity_for(needed), per_tile=False)

    @staticmethod
    def initial(gaussians: int, width_px: int, height_px: int) -> TileListCapacity:
        """Return the initial capacity: four tiles per Gaussian, and twice the mean in a tile."""
        tiles = math.ceil(width_px / TILE_SIZE) * math.ceil(height_px / TILE_SIZE)
        return TileListCapacity.for_frame(4 * gaussians, math.ceil(8 * gaussians / tiles))


class FrameNeeds(NamedTuple):
    """Instances needed by rendered frames, and the number of overflows."""

    instances: int
    """Largest number of instances in all tiles of a frame."""
    most_in_tile: int
    overflowed: int
    """Number of frames that dropped instances because their lists were full."""


class FrameStatusCopy:
    """Asynchronous copy of the last frame's status to the host.

    Enqueue the copy with `queue` (also inside a CUDA graph), call `launched` after the launch that
    contains it, then `wait`.
    """

    def __init__(self) -> None:
        self._arrived = torch.cuda.Event()
        self._values = torch.zeros(4, dtype=torch.int32, pin_memory=True)

    def __del__(self) -> None:
        # torch does not track writes of a graph and would free the memory while a copy is in
        # flight.
        self._arrived.synchronize()

    def queue(self, status: Tensor) -> None:
        """Enqueue the copy of a frame's `status` on the current stream."""
        self._values.copy_(status, non_blocking=True)

    def launched(self, device: torch.device) -> None:
        """Record the point on the current stream of `device` that `wait` waits for."""
        self._arrived.record(torch.cuda.current_stream(device))

    def wait(self) -> FrameNeeds:
        """Wait for the copy and return it."""
        self._arrived.synchronize()
        values = self._values.tolist()
        return FrameNeeds(values[STATUS_NEEDED], values[STATUS_LONGEST], values[STATUS_OVERFLOW])
