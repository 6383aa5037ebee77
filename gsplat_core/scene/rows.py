"""Gaussians stored in the first rows of preallocated tensors, so that addresses stay fixed.

A captured CUDA graph holds addresses and sizes, so growing tensors would require another capture.
The tensors therefore have the capacity of the largest scene. Rows after those in use are inert:
their opacity is 0, they are in no tile list, and they receive no gradient.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import Gaussians


@dataclass(frozen=True)
class RowMoves:
    """Row moves that keep the rows in use contiguous after removals.

    The last remaining rows move into the gaps.
    """

    to: Tensor
    """Destination rows, int64 [M]."""
    source: Tensor
    """Source rows, int64 [M]; disjoint from `to`."""
    count: int
    """Number of rows in use after the removal."""
    before: int
    """Number of rows in use before the removal."""

    @staticmethod
    def without(removed: Tensor) -> RowMoves:
        """Return the moves that close the gaps of removed rows; synchronises with the device.

        Args:
            removed: bool [N] over all rows in use.
        """
        stays = ~removed
        count = int(torch.count_nonzero(stays))
        to = torch.nonzero(removed[:count]).flatten()
        source = torch.nonzero(stays[count:]).flatten() + count
        return RowMoves(to, source, count, int(removed.shape[0]))

    @property
    def order(self) -> Tensor:
        """Return the moves as one gather index: the old row of each remaining row, int64 [count]."""
        order = torch.arange(self.count, device=self.to.device)
        order[self.to] = self.source
        return order

    def apply(self, tensor: Tensor, inert: float) -> None:
        """Move the rows of a tensor in place and fill unused rows with `inert`."""
        tensor[self.to] = tensor[self.source]
        tensor[self.count : self.before] = inert


def inert_gaussians(like: Gaussians, rows: int) -> Gaussians:
    """Create invisible Gaussians with the SH degree, dtype and device of `like`."""
    inert = like.map(lambda tensor: tensor.new_zeros(rows, *tensor.shape[1:]))
    inert.quats[:, 0] = 1
    inert.logit_opacities.fill_(-math.inf)
    return inert


class GaussianRows:
    """Gaussians of a scene in the first rows of tensors of fixed size."""

    def __init__(self, gaussians: Gaussians, capacity: int) -> None:
        if gaussians.count > capacity:
            raise InvalidInput(f"{gaussians.count} Gaussians do not fit into {capacity} rows")
        self.all = inert_gaussians(gaussians, capacity)
        """All rows, as read and changed by captured graphs."""
        self.used = self.all
        """Views of the rows in use."""
        self.replace(gaussians)

    @property
    def capacity(self) -> int:
        """Capacity in Gaussians."""
        return self.all.count

    def replace(self, gaussians: Gaussians) -> None:
        self._use(gaussians.count)
        for tensor, values in self._beside(gaussians):
            tensor.copy_(values)
        self._make_inert(gaussians.count)

    def append(self, added: Gaussians) -> None:
        """Write Gaussians into the rows after those in use."""
        first = self.used.count
        self._use(first + added.count)
        for tensor, values in self._beside(added):
            tensor[first:] = values

    def close_gaps(self, moves: RowMoves) -> None:
        """Remove Gaussians by moving rows into their gaps."""
        for tensor in self.all.tensors().values():
            moves.apply(tensor, 0.0)
        self._make_inert(moves.count)
        self._use(moves.count)

    def _beside(self, others: Gaussians) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield pairs of each tensor in use and the corresponding tensor of `others`."""
        others = others.like(self.used)
        return zip(self.used.tensors().values(), others.tensors().values(), strict=True)

    def _use(self, count: int) -> None:
        if count > self.capacity:
            raise InvalidInput(f"{count} Gaussians do not fit into {self.capacity} rows")
        self.used = self.all.map(lambda tensor: tensor[:count])

    def _make_inert(self, first: int) -> None:
        self.all.quats[first:, 0] = 1
        self.all.logit_opacities[first:] = -math.inf
