"""Tensors of a `BasisField`: Gaussians as rows, bumps as columns of a ring, Adam's state, and the weights that fit
given values.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Self

import torch
from torch import Tensor

from gsplat_core.deformation.field import ContinuedField, checked_window
from gsplat_core.errors import InvalidInput
from gsplat_core.machine import one_thread
from gsplat_core.ops.plain_torch import BASIS_CHANNELS, BUMP_REACH, basis_field
from gsplat_core.scene.gaussians import Gaussians, RowMoves


@dataclass(frozen=True)
class BasisRates:
    """Learning rates of `BasisField.adam_step`, in the units of the parameters (mm, quaternion, log, SH; bump spacings)."""

    position: float = 1e-2
    rotation: float = 1e-3
    log_scale: float = 5e-3
    colour: float = 5e-3
    centers: float = 1e-3
    widths: float = 1e-3


@dataclass
class Moments:
    """First and second moments of (centers, log_widths, weights), and update counts per bump."""

    first: list[Tensor]
    second: list[Tensor]
    steps: Tensor

    @staticmethod
    def zeros(parameters: Sequence[Tensor]) -> Moments:
        """Return the initial state for these parameters [N, B, ...]."""
        first, second = ([torch.zeros_like(p) for p in parameters] for _ in range(2))
        return Moments(first, second, torch.zeros_like(parameters[0], dtype=torch.int32))

    def map(self, change: Callable[[Tensor], Tensor]) -> Moments:
        """Return the moments with `change` applied to every tensor."""
        return Moments([change(t) for t in self.first], [change(t) for t in self.second], change(self.steps))

    def of_first(self, count: int) -> Moments:
        """Return views of the moments of the first `count` Gaussians."""
        return self if count == self.steps.shape[0] else self.map(lambda tensor: tensor[:count])


INERT_CENTER = 1e9
"""Centre of an unused column, in bump spacings; far enough to be inactive at any time."""
INERT = (INERT_CENTER, 0.0, 0.0)
"""Centre, log-width and weights of an unused column."""
CAPACITY_STEP = 16
"""Number of bump columns to a multiple of which the allocated capacity is rounded up."""
HEADROOM = 1.25
"""Factor by which more columns or rows are allocated than needed, so that few of many small additions move the tensors."""
COLUMNS_AHEAD = 1
"""Number of bump columns beyond the newest frame's time that are kept ready in a live session."""


@dataclass(frozen=True)
class Columns:
    """Layout of a field's columns.

    Columns are numbered from the oldest. Column n is stored at tensor index (oldest + n) % places. `oldest` is 0 unless
    the layout is a full ring.
    """

    origin_s: float
    """Time in seconds of the oldest column's initial bump centre. Normalised times are counted in spacings from it."""
    spacing_s: float
    count: int
    """Number of bump columns in use."""
    places: int
    """Number of bump columns allocated in the tensors."""
    oldest: int = 0
    """Tensor index of column 0, the oldest column."""
    is_ring: bool = False
    """True if new columns replace the oldest ones once all allocated columns are in use."""

    @property
    def spare(self) -> int:
        """Number of allocated columns that are not in use."""
        return self.places - self.count

    def moved_on(self, added: int) -> tuple[Columns, int]:
        """Return the column layout after appending `added` columns for later times, and the number of oldest columns that
        they replace.
        """
        passed = max(0, self.count + added - self.places)
        origin_s = self.origin_s + passed * self.spacing_s
        oldest = (self.oldest + passed) % self.places
        return replace(self, origin_s=origin_s, count=self.count + added - passed, oldest=oldest), passed

    @property
    def newest_place(self) -> int:
        """Tensor index of the newest column."""
        return (self.oldest + self.count - 1) % self.places

    def newest_places(self, count: int) -> Iterator[tuple[slice, range]]:
        """Yield the tensor indices of the newest `count` columns as one or two slices, each with its column numbers."""
        number = self.count - count
        while number < self.count:
            place = (self.oldest + number) % self.places
            length = min(self.count - number, self.places - place)
            yield slice(place, place + length), range(number, number + length)
            number += length

    def in_order(self, tensor: Tensor) -> Tensor:
        """Return the columns in use of [N, places, ...], oldest first."""
        if self.oldest == 0:
            return tensor[:, : self.count]
        return torch.cat([tensor[:, self.oldest :], tensor[:, : self.oldest]], dim=1)

    def laid_out(self, like: Tensor) -> Tensor:
        """Return the initial bump centres [places] in bump spacings, one per stored column, with dtype and device of
        `like`. Unused columns get `INERT_CENTER`, so that their bumps are 0 at any time.
        """
        columns = torch.arange(self.count, dtype=like.dtype, device=like.device)
        if self.spare:
            columns = torch.cat([columns, like.new_full((self.spare,), INERT_CENTER)])
        return columns.roll(self.oldest) if self.oldest else columns


def bump_capacity(bumps: int) -> int:
    """Return the number of columns to allocate for a field expected to grow beyond `bumps`."""
    return math.ceil(max(bumps * HEADROOM, 1) / CAPACITY_STEP) * CAPACITY_STEP


def ring_places(history_s: float, spacing_s: float) -> int:
    """Return the ring size for a history of `history_s` seconds.

    It includes the bumps that reach into the history and the columns that `BasisField.cover` keeps ahead.
    """
    return math.ceil(history_s / spacing_s - 1e-6) + int(BUMP_REACH) + COLUMNS_AHEAD + 4


def with_columns(tensor: Tensor, added: int, value: float = 0.0) -> Tensor:
    """Append `added` constant columns to [N, B, ...]."""
    return torch.cat([tensor, tensor.new_full((tensor.shape[0], added, *tensor.shape[2:]), value)], dim=1)


def columns_to_change(window_s: tuple[float, float], columns: Columns) -> tuple[int, int]:
    """Return the numbers of columns to add at the newest end and to drop at the oldest end, to cover a time window."""
    start, end = window_s
    spacing = columns.spacing_s
    last_s = columns.origin_s + (columns.count - 1) * spacing
    added = max(0, math.ceil((end + spacing - last_s) / spacing - 1e-6))
    dropped = max(0, math.floor((start - columns.origin_s) / spacing - BUMP_REACH))
    return added, min(dropped, columns.count + added - 4)


BUMPS_PER_SPACING = math.sqrt(math.pi)
"""Sum at any time of equal bumps of width 1 at unit spacing (within 0.02 %)."""


BEND = 0.05
"""Weight of the penalty on bending between bumps, relative to the squared error at one time.

Suppresses the noise of per-frame measurements.
"""


@one_thread()
def least_squares_weights(taus: Sequence[float], bumps: int) -> Tensor:
    """Return the matrix [B, T], float64, that maps values at `taus` to bump weights.

    The bumps have width 1 and centres 0, 1, .... The fit is least squares with a penalty on bending.
    """
    row = torch.arange(bumps, dtype=torch.float64)[None], torch.zeros(1, bumps, dtype=torch.float64)
    each = torch.eye(bumps, dtype=torch.float64)[None]
    heights = torch.stack([basis_field(*row, each, tau)[0] for tau in taus]) if taus else each.new_zeros(0, bumps)
    bends = torch.eye(bumps, dtype=torch.float64).diff(n=2, dim=0)
    return torch.linalg.solve(heights.T @ heights + BEND * bends.T @ bends + 1e-6 * torch.eye(bumps), heights.T)


@lru_cache(maxsize=4)
def kept_weights(taus: tuple[float, ...], bumps: int) -> Tensor:
    """Return `least_squares_weights`, which is kept, because it is needed for every frame that adds Gaussians. Callers must not
    modify it.
    """
    return least_squares_weights(taus, bumps)


class BumpTensors(ContinuedField):
    """Centres and log-widths [N, B], weights [N, B, 13], and their moments once trained.

    Rows are Gaussians and columns are bumps. Both may include inert spare entries, for reserved Gaussians (`reserve`)
    and for later times.
    """

    def __init__(
        self, count: int, time_window_s: tuple[float, float], *, bumps: int = 26, spacing_s: float | None = None
    ) -> None:
        """Create columns over the window: `bumps` of them, or as many as a distance of `spacing_s` needs."""
        super().__init__(time_window_s)
        start, end = self._time_window_s
        if spacing_s is not None:
            if not (math.isfinite(spacing_s) and spacing_s > 0):
                raise InvalidInput(f"spacing_s must be a positive number of seconds, got {spacing_s}")
            bumps = max(4, math.ceil((end - start) / spacing_s - 1e-6) + 3)
        if bumps < 4:
            raise InvalidInput(f"bumps must be at least 4 (one past each end of the window), got {bumps}")
        spacing = spacing_s or ((end - start) or 1.0) / (bumps - 3)
        self._columns = Columns(start - spacing, spacing, bumps, bumps)
        self._history_s: float | None = None
        self._fading_s = math.inf
        self._spare_rows = 0
        """Number of inert Gaussian rows at the end of the tensors, which `append` uses without reallocation."""
        self.centers = torch.nn.Parameter(torch.arange(bumps, dtype=torch.float32).repeat(count, 1))
        self.log_widths = torch.nn.Parameter(torch.zeros(count, bumps))
        self.weights = torch.nn.Parameter(torch.zeros(count, bumps, BASIS_CHANNELS))
        self._moments: Moments | None = None

    @property
    def count(self) -> int:
        """Number of Gaussians N."""
        return int(self.weights.shape[0]) - self._spare_rows

    @property
    def bumps(self) -> int:
        """Number of bumps per Gaussian B; the parameters may have spare columns beyond them."""
        return self._columns.count

    @property
    def spacing_s(self) -> float:
        """Initial distance between neighbouring bumps in seconds."""
        return self._columns.spacing_s

    @property
    def columns(self) -> Columns:
        """Layout of the bump columns: their positions in time and in the tensors."""
        return self._columns

    def frame_time(self, time_s: float) -> float:
        """Convert a time, clamped to the window, to bump spacings since the first column."""
        return (self.clamp_time(time_s) - self._columns.origin_s) / self._columns.spacing_s

    def deltas(self, time_s: float) -> Tensor:
        """Return the deltas [N, 13] at `time_s`: position, rotation, log-scale, colour; differentiable."""
        raise NotImplementedError

    def keep_last(self, history_s: float, fading_s: float = math.inf) -> None:
        """Keep only the last `history_s` seconds before the newest frame deformable.

        All memory is allocated here. New bumps replace the oldest ones, and no tensor moves while
        the stream continues. Times before the window show its first state. During training, deltas
        carried into new bumps decay with time constant `fading_s`.

        Args:
            history_s: deformable past in seconds.
            fading_s: decay time constant in seconds; infinity for no decay.

        Raises:
            InvalidInput: if `history_s` is not positive.
        """
        if not (math.isfinite(history_s) and history_s > 0):
            raise InvalidInput(f"history_s must be a positive number of seconds, got {history_s}")
        places = max(ring_places(history_s, self.spacing_s), self._columns.places)
        self._add_places(places - self._columns.places)
        self._columns = replace(self._columns, is_ring=True)
        self._history_s, self._fading_s = history_s, fading_s

    def restart(self, time_s: float, count: int) -> None:
        """Reset the field in place; see `FixedRows.restart`."""
        spare_rows = self.weights.shape[0] - count
        if spare_rows < 0:
            raise InvalidInput(f"a field with {self.weights.shape[0]} rows cannot restart with {count} Gaussians")
        self._spare_rows = spare_rows
        self._time_window_s = checked_window((time_s, time_s + COLUMNS_AHEAD * self.spacing_s))
        origin_s = time_s - self.spacing_s
        self._columns = replace(self._columns, origin_s=origin_s, count=COLUMNS_AHEAD + 3, oldest=0)
        for tensor, inert in self._tensors_and_fill():
            tensor.fill_(inert)
        self.centers.data[:count] = self._columns.laid_out(self.centers.data)

    def extend(self, time_window_s: tuple[float, float], *, hold_at_s: float | None = None) -> None:
        """Advance the window: append bumps at the head and drop expired ones at the tail.

        Start and end may only increase. New bumps have zero weights, or continue the deformation at
        `hold_at_s`. Tissue hidden by a tool then keeps its last observed state instead of returning
        to its canonical one. After the window the field holds its last state. A bump is dropped if
        its initial centre is more than 4 spacings before the new start. After `keep_last`, the
        oldest bumps are overwritten, and the window starts where the remaining ones reach.
        """
        start, end = checked_window(time_window_s)
        if start < self._time_window_s[0] or end < self._time_window_s[1]:
            raise InvalidInput(f"the window {self._time_window_s} can only move forward, got {(start, end)}")
        added, dropped = columns_to_change((start, end), self._columns)
        if added:
            passed = self._append_columns(added, None if hold_at_s is None else self._held(hold_at_s))
            if passed:
                start = max(start, self._columns.origin_s + BUMP_REACH * self.spacing_s)
        if dropped and not self._columns.is_ring:
            self._drop_columns(dropped)
        self._time_window_s = (start, end)

    def cover(self, time_s: float, newest_s: float) -> None:
        """Extend the window by columns that continue from `newest_s` if it ends less than `COLUMNS_AHEAD` columns after
        `time_s`.
        """
        start, end = self._time_window_s
        ahead_s = COLUMNS_AHEAD * self.spacing_s
        if time_s + ahead_s > end:
            if self._history_s is not None:
                start = max(start, time_s - self._history_s)
            self.extend((start, time_s + ahead_s + self.spacing_s), hold_at_s=newest_s)

    def select(self, index: Tensor) -> None:
        """Keep only the bumps of the Gaussians in `index` (int64 rows or bool mask), in that order."""
        used = self.count
        self._set_parameters(*(p.data[:used][index] for p in self._whole_parameters()))
        self._change_moments(lambda t: t[:used][index])
        self._spare_rows = 0

    def append(self, count: int, parents: Tensor | None = None) -> None:
        """Append zero bumps for new Gaussians, or copies of the bumps of `parents`, with new Adam state."""
        used = self.count
        if parents is not None and parents.shape != (count,):
            raise InvalidInput(f"parents must be [{count}], one for each new Gaussian, got {list(parents.shape)}")
        if count > self._spare_rows:
            self.reserve(used + count if used == 0 else math.ceil(HEADROOM * (used + count)))
        self._spare_rows -= count
        if parents is not None:
            for parameter in self._whole_parameters():
                parameter.data[used : used + count] = parameter.data[parents]
        else:
            self.centers.data[used : used + count] = self._columns.laid_out(self.centers.data)

    def reserve(self, rows: int) -> None:
        """Allocate inert rows; see `FixedRows.reserve`."""
        added = rows - self.weights.shape[0]
        if added > 0:
            widened = (
                torch.cat([p.data, p.data.new_full((added, *p.shape[1:]), inert)])
                for p, inert in zip(self._whole_parameters(), INERT, strict=True)
            )
            self._set_parameters(*widened)
            self._change_moments(lambda t: torch.cat([t, t.new_zeros(added, *t.shape[1:])]))
            self._spare_rows += added

    def close_gaps(self, moves: RowMoves) -> None:
        """Move rows into the gaps that removed Gaussians left; see `FixedRows.close_gaps`. Tensors keep their
        addresses.
        """
        for tensor, inert in self._tensors_and_fill():
            moves.apply(tensor, inert)
        self._spare_rows += moves.before - moves.count

    def config(self) -> dict[str, Any]:
        """Return kind, window and column layout."""
        return {
            **super().config(),
            "bumps": self.bumps,
            "channels": BASIS_CHANNELS,
            "origin_s": self._columns.origin_s,
            "spacing_s": self._columns.spacing_s,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any], gaussians: Gaussians) -> Self:
        """Create an untrained field with the column layout of `config`; the caller then loads its tensors."""
        start, end = config["time_window_s"]
        field = cls(gaussians.count, (start, end), bumps=config["bumps"])
        field._columns = replace(
            field._columns, origin_s=float(config["origin_s"]), spacing_s=float(config["spacing_s"])
        )
        return field

    def detached_copy(self) -> Self:
        """Return a copy of the Gaussians and bumps in use, in chronological order and without ring."""
        return self._copy_of(self.count)

    def _copy_of(self, rows: int) -> Self:
        memo: dict[int, Any] = {id(self._moments): None}
        for parameter in self._whole_parameters():
            kept = self._columns.in_order(parameter.data[:rows]).clone(memory_format=torch.contiguous_format)
            memo[id(parameter)] = torch.nn.Parameter(kept, requires_grad=False)
        copied = copy.deepcopy(self, memo)
        copied._columns = replace(self._columns, places=self.bumps, oldest=0, is_ring=False)
        copied._history_s, copied._fading_s, copied._spare_rows = None, math.inf, 0
        return copied.requires_grad_(False)

    def _held(self, time_s: float) -> Tensor:
        """Return the deltas [N, 13] at `time_s` with which new bumps start; decayed for Gaussians trained since the newest bump
        was created.
        """
        deltas = self.deltas(time_s).detach()
        if self._fading_s == math.inf or self._moments is None:
            return deltas
        # Decay only where the newest column was trained since its creation, one spacing ago. Gaussians hidden since then
        # keep their deltas.
        trained = self._moments.steps[: self.count, self._columns.newest_place] > 0
        return torch.where(trained[:, None], deltas * math.exp(-self.spacing_s / self._fading_s), deltas)

    def _append_columns(self, added: int, held: Tensor | None) -> int:
        """Append columns for later times and return the number of oldest columns that they replaced."""
        before = self._columns
        if added > before.spare and not before.is_ring:
            end = before.count + added
            self._add_places((end if self.weights.is_cpu else bump_capacity(end)) - before.places)
        self._columns, passed = self._columns.moved_on(added)
        if passed:
            self.centers.data[: self.count] -= (
                passed  # no rounding: initial centres are whole numbers, and this makes them smaller
            )
        for places, numbers in self._columns.newest_places(min(added, self.bumps)):
            self._lay_out(places, numbers, held)
        return passed

    def _lay_out(self, places: slice, numbers: range, held: Tensor | None) -> None:
        """Overwrite these tensor columns with new bumps of weight 0, or of weights that give the deltas `held` [N, 13]."""
        used = self.count
        for tensor, inert in self._tensors_and_fill():
            tensor[:used, places] = inert
        centers = self.centers.data[:used, places]
        centers.copy_(torch.arange(numbers.start, numbers.stop, dtype=centers.dtype, device=centers.device))
        if held is not None:
            self.weights.data[:used, places] = held[:, None] / BUMPS_PER_SPACING

    def _drop_columns(self, dropped: int) -> None:
        columns = self._columns
        self._set_parameters(*(p.data[:, dropped:] for p in self._whole_parameters()))
        self.centers.data -= dropped
        self._change_moments(lambda t: t[:, dropped:].contiguous())
        origin_s = columns.origin_s + dropped * columns.spacing_s
        self._columns = replace(
            columns, origin_s=origin_s, count=columns.count - dropped, places=columns.places - dropped
        )

    def _add_places(self, added: int) -> None:
        widened = (with_columns(p.data, added, v) for p, v in zip(self._whole_parameters(), INERT, strict=True))
        self._set_parameters(*widened)
        self._change_moments(lambda t: with_columns(t, added))
        self._columns = replace(self._columns, places=self._columns.places + added)

    def _moments_in_use(self) -> Moments:
        if self._moments is None:
            self._moments = Moments.zeros([p.data for p in self._whole_parameters()])
        return self._moments

    def _whole_parameters(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return centres, log-widths and weights including spare rows and columns."""
        return self.centers, self.log_widths, self.weights

    def _tensors_and_fill(self) -> Iterator[tuple[Tensor, float]]:
        """Yield every tensor with rows and columns, and the value that marks an entry without a bump."""
        yield from zip((p.data for p in self._whole_parameters()), INERT, strict=True)
        if self._moments is not None:
            yield from ((moment, 0.0) for moment in (*self._moments.first, *self._moments.second, self._moments.steps))

    def _set_parameters(self, centers: Tensor, log_widths: Tensor, weights: Tensor) -> None:
        """Replace the parameters; optimisers that hold the old ones become invalid."""
        requires_grad = self.weights.requires_grad
        for name, values in (("centers", centers), ("log_widths", log_widths), ("weights", weights)):
            setattr(self, name, torch.nn.Parameter(values.contiguous(), requires_grad))

    def _change_moments(self, change: Callable[[Tensor], Tensor]) -> None:
        if self._moments is not None:
            self._moments = self._moments.map(change)
