"""The columns of a `BasisField`: which bumps a window needs, and at which place of the tensors each of them lies.

Places that hold no column yet are inert. They become bumps without moving a tensor, and in a ring the place of the oldest column does so again,
so that captured CUDA graphs stay valid and memory does not grow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsplat_core.ops.basis_field.plain_torch import BUMP_REACH

INERT_CENTER = 1e9
"""Centre of a column that is no bump yet, in bump spacings: too far from any time to contribute or to be trained."""
INERT = (INERT_CENTER, 0.0, 0.0)
"""Centre, log-width and weights of such a column."""
CAPACITY_STEP = 16
"""The capacity for bumps is a multiple of this."""
HEADROOM = 1.25
COLUMNS_AHEAD = 1
"""Columns that the window keeps ahead of the newest frame online."""


@dataclass(frozen=True)
class Columns:
    """The columns of a field, numbered from the oldest, and where they lie: number n at place (oldest + n) % places.

    Only a ring whose places are all in use starts elsewhere than at place 0.
    """

    origin_s: float
    """Where the oldest column was laid out: time is counted in spacings from there."""
    spacing_s: float
    count: int
    """Columns in use."""
    places: int
    """Columns of the tensors."""
    oldest: int = 0
    """The place of column 0."""
    is_ring: bool = False
    """Whether new columns take the places of the oldest ones once all are in use."""

    @property
    def spare(self) -> int:
        """Places that hold no column yet."""
        return self.places - self.count

    def moved_on(self, added: int) -> tuple[Columns, int]:
        """With `added` more columns at the head, and how many of the oldest gave up their places for them."""
        passed = max(0, self.count + added - self.places)
        origin_s = self.origin_s + passed * self.spacing_s
        oldest = (self.oldest + passed) % self.places
        return replace(self, origin_s=origin_s, count=self.count + added - passed, oldest=oldest), passed

    @property
    def newest_place(self) -> int:
        """The place of the newest column."""
        return (self.oldest + self.count - 1) % self.places

    def newest_places(self, count: int) -> Iterator[tuple[slice, range]]:
        """The places of the newest `count` columns in one or two pieces, each with the numbers of its columns."""
        number = self.count - count
        while number < self.count:
            place = (self.oldest + number) % self.places
            length = min(self.count - number, self.places - place)
            yield slice(place, place + length), range(number, number + length)
            number += length

    def in_order(self, tensor: Tensor) -> Tensor:
        """The columns in use of [N, places, ...], the oldest first."""
        if self.oldest == 0:
            return tensor[:, : self.count]
        return torch.cat([tensor[:, self.oldest :], tensor[:, : self.oldest]], dim=1)

    def laid_out(self, like: Tensor) -> Tensor:
        """The centres [places] of columns that were not trained, of the type and on the device of `like`."""
        columns = torch.arange(self.count, dtype=like.dtype, device=like.device)
        if self.spare:
            columns = torch.cat([columns, like.new_full((self.spare,), INERT_CENTER)])
        return columns.roll(self.oldest) if self.oldest else columns


def bump_capacity(bumps: int) -> int:
    """The columns to allocate for a field with so many bumps that is going to have more."""
    return math.ceil(max(bumps * HEADROOM, 1) / CAPACITY_STEP) * CAPACITY_STEP


def ring_places(history_s: float, spacing_s: float) -> int:
    """The places of a ring that keeps `history_s` seconds: the bumps that reach into them, and what `BasisField.cover` keeps ahead."""
    return math.ceil(history_s / spacing_s - 1e-6) + int(BUMP_REACH) + COLUMNS_AHEAD + 4


def with_columns(tensor: Tensor, added: int, value: float = 0.0) -> Tensor:
    """[N, B, ...] with `added` more columns of one value."""
    return torch.cat([tensor, tensor.new_full((tensor.shape[0], added, *tensor.shape[2:]), value)], dim=1)


def columns_to_change(window_s: tuple[float, float], columns: Columns) -> tuple[int, int]:
    """How many bumps to add at the head and to drop at the tail, so that `columns` cover the window."""
    start, end = window_s
    spacing = columns.spacing_s
    last_s = columns.origin_s + (columns.count - 1) * spacing
    added = max(0, math.ceil((end + spacing - last_s) / spacing - 1e-6))
    dropped = max(0, math.floor((start - columns.origin_s) / spacing - BUMP_REACH))
    return added, min(dropped, columns.count + added - 4)
