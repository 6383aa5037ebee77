"""Gaussians as the first rows of larger tensors: they join and leave while every tensor stays where it is.

A captured CUDA graph holds addresses and sizes, so a scene whose tensors grow has to be captured again. Here the tensors are as large as the
scene may become. The rows in use come first; those behind them are inert: opacity 0, in no tile list, without a gradient.
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
    """How the rows in use stay the first ones when some of them leave: the last ones that stay move into the gaps."""

    to: Tensor
    """Rows that others move into, int64 [M]."""
    source: Tensor
    """Rows that move there [M]. None of them is in `to`."""
    count: int
    """How many rows are in use afterwards."""
    before: int
    """How many were in use before."""

    @staticmethod
    def without(removed: Tensor) -> RowMoves:
        """Close the gaps of the rows marked in `removed`, bool [N] over all rows in use. Waits for the device."""
        stays = ~removed
        count = int(torch.count_nonzero(stays))
        to = torch.nonzero(removed[:count]).flatten()
        source = torch.nonzero(stays[count:]).flatten() + count
        return RowMoves(to, source, count, int(removed.shape[0]))

    @property
    def order(self) -> Tensor:
        """The same as one selection: for each row in use afterwards, the row in which it was before, int64 [count]."""
        order = torch.arange(self.count, device=self.to.device)
        order[self.to] = self.source
        return order

    def apply(self, tensor: Tensor, inert: float) -> None:
        """Move the rows of one tensor in place; the rows that are not in use any more are filled with `inert`."""
        tensor[self.to] = tensor[self.source]
        tensor[self.count : self.before] = inert


def inert_gaussians(like: Gaussians, rows: int) -> Gaussians:
    """Gaussians that no renderer shows, with the harmonics, type and device of `like`."""
    inert = like.map(lambda tensor: tensor.new_zeros(rows, *tensor.shape[1:]))
    inert.quats[:, 0] = 1
    inert.logit_opacities.fill_(-math.inf)
    return inert


class GaussianRows:
    """The Gaussians of a scene in tensors of fixed size."""

    def __init__(self, gaussians: Gaussians, capacity: int) -> None:
        if gaussians.count > capacity:
            raise InvalidInput(f"{gaussians.count} Gaussians do not fit into {capacity} rows")
        self.all = inert_gaussians(gaussians, capacity)
        """Every row: what a captured graph reads and changes."""
        self.used = self.all
        """The rows in use, in the same memory."""
        self.replace(gaussians)

    @property
    def capacity(self) -> int:
        """How many Gaussians there is room for."""
        return self.all.count

    def replace(self, gaussians: Gaussians) -> None:
        """Let other Gaussians take the place of all."""
        self._use(gaussians.count)
        for tensor, values in self._beside(gaussians):
            tensor.copy_(values)
        self._make_inert(gaussians.count)

    def append(self, added: Gaussians) -> None:
        """Write Gaussians into the rows behind those in use."""
        first = self.used.count
        self._use(first + added.count)
        for tensor, values in self._beside(added):
            tensor[first:] = values

    def close_gaps(self, moves: RowMoves) -> None:
        """Let Gaussians leave."""
        for tensor in self.all.tensors().values():
            moves.apply(tensor, 0.0)
        self._make_inert(moves.count)
        self._use(moves.count)

    def _beside(self, others: Gaussians) -> Iterator[tuple[Tensor, Tensor]]:
        """Each tensor in use beside that of others."""
        others = others.with_right(self.used.right_sh is not None)
        return zip(self.used.tensors().values(), others.tensors().values(), strict=True)

    def _use(self, count: int) -> None:
        if count > self.capacity:
            raise InvalidInput(f"{count} Gaussians do not fit into {self.capacity} rows")
        self.used = self.all.map(lambda tensor: tensor[:count])

    def _make_inert(self, first: int) -> None:
        self.all.quats[first:, 0] = 1
        self.all.logit_opacities[first:] = -math.inf
