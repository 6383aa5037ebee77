"""Room for the lists of splats that every tile of a frame has, and how a frame tells that it needs more."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.ops.frame.frame import MAX_SEGMENT, STATUS_LONGEST, STATUS_NEEDED, STATUS_OVERFLOW, TILE_SIZE

CAPACITY_STEP = 1 << 16
"""Lists in one room grow by multiples of this many instances (a splat in a tile)."""
TILE_STEP = 32
"""A tile's own room grows by multiples of this many."""
HEADROOM = 1.25
"""Room kept beyond what a frame needed, so that a scene that moves seldom outgrows its lists."""


def capacity_for(needed: int) -> int:
    """How many instances to make room for where `needed` were seen."""
    return max(1, math.ceil(needed * HEADROOM / CAPACITY_STEP)) * CAPACITY_STEP


@dataclass(frozen=True)
class ListRoom:
    """`capacity` and `per_tile` as `render_frame` takes them."""

    capacity: int
    per_tile: bool

    @staticmethod
    def for_frame(needed: int, most: int) -> ListRoom:
        """For a frame with `needed` instances, `most` of them in one tile.

        Rooms of their own are faster. They take up to 32 bytes a pixel; where a tile has more than fits then, all lists share one.
        """
        of_tile = max(1, math.ceil(most * HEADROOM / TILE_STEP)) * TILE_STEP
        if of_tile <= MAX_SEGMENT:
            return ListRoom(of_tile, per_tile=True)
        return ListRoom(capacity_for(needed), per_tile=False)

    @staticmethod
    def at_first(gaussians: int, width_px: int, height_px: int) -> ListRoom:
        """Before any frame: for four tiles a Gaussian, and tiles with twice the mean."""
        tiles = math.ceil(width_px / TILE_SIZE) * math.ceil(height_px / TILE_SIZE)
        return ListRoom.for_frame(4 * gaussians, math.ceil(8 * gaussians / tiles))


class FrameNeeds(NamedTuple):
    """What the last frame needed, in instances."""

    in_all: int
    in_a_tile: int
    """The most in one tile."""
    cut: int
    """How many frames had to leave some out for want of room."""


class StatusOnHost:
    """What the last frame needed, copied to the host behind its launches and read when it has arrived.

    The copy may be part of a CUDA graph: `fetch` in it, `mark` behind each of its launches, then `wait`.
    """

    def __init__(self) -> None:
        self._arrived = torch.cuda.Event()
        self._values = torch.zeros(4, dtype=torch.int32, pin_memory=True)

    def __del__(self) -> None:
        # torch does not know of copies in graphs: it would give the memory to somebody else while one is still on its way there.
        self._arrived.synchronize()

    def fetch(self, status: Tensor) -> None:
        """Queue the copy of `status` behind what was launched."""
        self._values.copy_(status, non_blocking=True)

    def mark(self, device: torch.device) -> None:
        """What is queued on the current stream of `device` until now is what `wait` waits for."""
        self._arrived.record(torch.cuda.current_stream(device))

    def wait(self) -> FrameNeeds:
        """What the copy in front of the last mark has brought; waits for it."""
        self._arrived.synchronize()
        values = self._values.tolist()
        return FrameNeeds(values[STATUS_NEEDED], values[STATUS_LONGEST], values[STATUS_OVERFLOW])
