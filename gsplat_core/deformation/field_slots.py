"""Copies of a field whose tensors stay at the same addresses while newer states of the field are written over them.

A captured CUDA graph can therefore read the field of every published snapshot. Used by `gsplat_core.scene.snapshots`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from gsplat_core.deformation.basis_columns import INERT, INERT_CENTER, bump_capacity
from gsplat_core.deformation.continuation import Continuation

if TYPE_CHECKING:
    from gsplat_core.deformation.basis import BasisField
    from gsplat_core.deformation.field import DeformationField


class FieldSlot(Protocol):
    """One copy of a field that is written over."""

    @property
    def field(self) -> DeformationField:
        """The copy, for as many Gaussians as the slot has rows; only its times and the values of its tensors change."""

    @property
    def parameter_count(self) -> int:
        """Numbers in all tensors of the field as it was written last."""

    def overwrite(self, source: DeformationField) -> bool:
        """Take over the state of `source`, queued on the current stream; False, with nothing changed, where it does not fit."""

    def exact_copy(self) -> DeformationField:
        """The field as it was written last, of its own size and in memory of its own."""


def copy_each(to: list[Tensor], values: list[Tensor]) -> None:
    """Copy every tensor into the one at its place: one call, and as few launches as torch can make of it."""
    torch._foreach_copy_(to, values, non_blocking=True)


class WholeFieldSlot:
    """For a field without tensors per Gaussian: its tensors never change their shapes."""

    def __init__(self, source: DeformationField, rows: int) -> None:
        self.field = source.detached_copy()
        self.parameter_count = sum(tensor.numel() for tensor in self.field.state_dict().values())

    def overwrite(self, source: DeformationField) -> bool:
        """Copy every parameter and buffer, and the time window."""
        mine, theirs = self.field.state_dict(keep_vars=True), source.state_dict(keep_vars=True)
        if {name: t.shape for name, t in mine.items()} != {name: t.shape for name, t in theirs.items()}:
            return False
        copy_each([tensor.data for tensor in mine.values()], [theirs[name].data for name in mine])
        self.field._time_window_s = source.time_window_s
        return True

    def exact_copy(self) -> DeformationField:
        """Another copy."""
        return self.field.detached_copy()


class BasisSlot:
    """A basis field with capacity for more Gaussians and more bumps than it has; those that are not in use are inert."""

    def __init__(self, source: BasisField, rows: int) -> None:
        # A ring has its places from the start, and the copy has the same ones.
        places = source.columns.places if source.columns.is_ring else bump_capacity(source.bumps)
        with torch.device(source.weights.device):
            self.field = type(source)(rows, source.time_window_s, bumps=places)
        self.field.requires_grad_(False)
        self.field.centers.data.fill_(INERT_CENTER)
        if source.continuation is not None:
            self.field.continuation = Continuation(rows, source.weights.device)
        self._used = 0, 0
        self._in_use: list[Tensor] = [tensor.data[:0, :0] for tensor in self.field.parameters()]

    @property
    def parameter_count(self) -> int:
        """Of the rows and bumps in use."""
        count, bumps = self._used
        return count * bumps * (2 + int(self.field.weights.shape[2]))

    def overwrite(self, source: DeformationField) -> bool:
        """Copy the bumps and the layout of the columns, and make inert what an earlier state had used beyond them."""
        if not isinstance(source, type(self.field)):
            return False
        if source.continuation is not None and self.field.continuation is None:
            return False
        count, columns = source.count, source.columns
        places = int(self.field.weights.shape[1])
        if count > self.field.count or columns.count > places or (columns.is_ring and columns.places != places):
            return False
        if self._used != (count, columns.count):
            self._use(count, columns.count)
        theirs = (source.centers.data, source.log_widths.data, source.weights.data)
        # Bumps lie at the first places, or in a ring at all of them.
        copy_each(self._in_use, [values[:count, : columns.count] for values in theirs])
        self.field._time_window_s = source.time_window_s
        self.field._columns = replace(columns, places=places)
        self._continue(source.continuation, count)
        return True

    def _continue(self, source: Continuation | None, count: int) -> None:
        """Continue as `source` does, or not at all."""
        mine = self.field.continuation
        if mine is None:
            return
        if source is None:
            mine.stop()
            return
        mine.write(source.velocity[:count], source.from_s, source.horizon_s)
        mine.set_clock(self.field.tau, self.field.spacing_s)

    def _use(self, count: int, bumps: int) -> None:
        """Choose the part of every tensor that is written, and make inert what an earlier state had used beyond it."""
        mine = (self.field.centers.data, self.field.log_widths.data, self.field.weights.data)
        rows, columns = self._used
        for to, inert in zip(mine, INERT, strict=True):
            if rows > count:
                to[count:rows].fill_(inert)
            if columns > bumps:
                to[:, bumps:columns].fill_(inert)
        self._used = count, bumps
        self._in_use = [to[:count, :bumps] for to in mine]

    def exact_copy(self) -> DeformationField:
        """A field of as many Gaussians and bumps as are in use."""
        copied = self.field._copy_of(self._used[0])
        if self.field.continuation is not None:
            copied.continuation = self.field.continuation.of_first(self._used[0])
        return copied
