"""Per-Gaussian basis functions in time: bumps that move, turn, scale and colour each Gaussian, local in time.

The idea is Deform3DGS's (Yang et al. 2024), with one timing per bump shared by all channels, colour added, and truncated
bumps, so that one time touches few of them: reading, training and storing a stretch of time costs the same however long
the stream is.

Inside the field time is counted in bump spacings from the first column, tau = (time_s - origin_s) / spacing_s, so column b
starts with centre b and width 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, Self, cast

import torch
from torch import Tensor

from gsplat_core.deformation.basis_adam import BasisRates, Moments
from gsplat_core.deformation.basis_columns import INERT, bump_capacity, columns_to_change, laid_out, with_columns
from gsplat_core.deformation.basis_shift import shifted_bumps_
from gsplat_core.deformation.continuation import Continuation
from gsplat_core.deformation.field import DeformationField, checked_window, count_of, ops_for
from gsplat_core.deformation.field_slots import BasisSlot
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.basis_field import basis_field as compiled
from gsplat_core.ops.basis_field import plain_torch
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.layout import BASIS_CHANNELS, BASIS_GROUPS, POSITION, width_of

COLUMNS_AHEAD = 1
"""Columns that the window keeps ahead of the newest frame online."""
BUMPS_PER_SPACING = math.sqrt(math.pi)
"""What a row of equal bumps of width 1, one per spacing, adds up to at any time (within 0.02 %)."""


class BasisField(DeformationField):
    """B bumps per Gaussian, 13 channels each: position 3, rotation 4, log-scale 3, colour 3 (added to the SH DC term).

    Parameters: `centers` [N, B] and `log_widths` [N, B] in bump spacings, `weights` [N, B, 13], zero at first. The columns
    cover the window plus one spacing at each end. A bump more than 4 widths away contributes nothing and gets no gradient.

    Training has two ways: `forward` is differentiable for any optimiser; `deltas`, `displaced` and `adam_step` do the same with
    the gradient and a lazy Adam step fused, which touches only the bumps active at that time.
    """

    kind = "basis"
    slot_type = BasisSlot
    continues = True

    def __init__(
        self, count: int, time_window_s: tuple[float, float], *, bumps: int = 26, spacing_s: float | None = None
    ) -> None:
        """`bumps` columns spread over the window, or as many as it takes at a distance of `spacing_s`."""
        super().__init__(time_window_s)
        start, end = self._time_window_s
        if spacing_s is not None:
            if not (math.isfinite(spacing_s) and spacing_s > 0):
                raise InvalidInput(f"spacing_s must be a positive number of seconds, got {spacing_s}")
            bumps = max(4, math.ceil((end - start) / spacing_s - 1e-6) + 3)
        if bumps < 4:
            raise InvalidInput(f"bumps must be at least 4 (one past each end of the window), got {bumps}")
        self._spacing_s = spacing_s or ((end - start) or 1.0) / (bumps - 3)
        self._origin_s = start - self._spacing_s
        self.centers = torch.nn.Parameter(torch.arange(bumps, dtype=torch.float32).repeat(count, 1))
        self.log_widths = torch.nn.Parameter(torch.zeros(count, bumps))
        self.weights = torch.nn.Parameter(torch.zeros(count, bumps, BASIS_CHANNELS))
        self._moments: Moments | None = None
        self._spare: int = 0
        """Inert columns at the end, which `extend` turns into bumps without moving a tensor: captured graphs stay valid."""

    @classmethod
    def for_gaussians(cls, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any) -> BasisField:
        return cls(gaussians.count, time_window_s, **architecture)

    @property
    def count(self) -> int:
        """Number of Gaussians N."""
        return int(self.weights.shape[0])

    @property
    def bumps(self) -> int:
        """Number of bumps per Gaussian B; on a GPU the parameters may have spare columns beyond them."""
        return int(self.weights.shape[1]) - self._spare

    @property
    def spacing_s(self) -> float:
        """Seconds between neighbouring bumps as they are laid out."""
        return self._spacing_s

    def tau(self, time_s: float) -> float:
        """Time in bump spacings from the first column, clamped to the window."""
        return (self.clamp_time(time_s) - self._origin_s) / self._spacing_s

    def deltas(self, time_s: float) -> Tensor:
        """What the field adds at `time_s`: [N, 13] position, rotation, log-scale, colour. Differentiable."""
        past = self.continuation
        bumps_s = time_s if past is None else min(time_s, past.from_s)
        deltas = cast(Tensor, self._ops.basis_field(self.centers, self.log_widths, self.weights, self.tau(bumps_s)))
        added = None if past is None else past.added(time_s, self.count)
        return deltas if added is None else deltas + added[:, :BASIS_CHANNELS]

    def displaced(self, gaussians: Gaussians, deltas: Tensor) -> Gaussians:
        """The Gaussians with `deltas` [N, 13] added; differentiable in both."""
        if gaussians.count != deltas.shape[0]:
            raise InvalidInput(
                f"the field holds bumps for {deltas.shape[0]} Gaussians, got {gaussians.count}; call"
                " select or append when Gaussians are removed or added"
            )
        position, rotation, log_scale, colour = torch.split(deltas, [width_of(group) for group in BASIS_GROUPS], dim=1)
        sh = gaussians.sh
        base = sh[:, :1] + colour[:, None]
        return Gaussians(
            means=gaussians.means + position,
            quats=gaussians.quats + rotation,
            log_scales=gaussians.log_scales + log_scale,
            logit_opacities=gaussians.logit_opacities,
            sh=base if sh.shape[1] == 1 else torch.cat([base, sh[:, 1:]], dim=1),
        )

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        """The Gaussians at `time_s`; outside the window the state of its nearest end."""
        return self.displaced(gaussians, self.deltas(time_s))

    def adam_step(self, time_s: float, gradient: Tensor, rates: BasisRates) -> None:
        """Lazy Adam of the bumps active at `time_s`, given dL/d(deltas) `gradient` [N, 13]; the others are left alone.

        The moments live in the field, follow `select`, `append` and `extend`, and are not part of a bundle. On CUDA the host does
        not wait.
        """
        each = (rates.position, rates.rotation, rates.log_scale, rates.colour, rates.centers, rates.widths)
        self.adam_step_at(self.tau(time_s), gradient, each)

    def adam_step_at(
        self,
        tau: float | Tensor,
        gradient: Tensor,
        rates: Sequence[float] | Tensor,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-8,
    ) -> None:
        """As `adam_step`, at a `tau` of `self.tau` and with the six `rates` of `BasisRates` in order.

        Both may be float32 tensors on the field's device ([1] and [6]), which a CUDA graph reads anew at every replay; `gradient`
        may be [N, 16], the frame path's v_raw.
        """
        moments = self._moments_in_use()
        self._ops.basis_field_backward_adam_(
            gradient, tau, [p.data for p in self._parameters_in_order()], moments.first, moments.second, moments.steps,
            rates, betas, epsilon,
        )  # fmt: skip

    @property
    def has_frame_deltas(self) -> bool:
        """Always."""
        return True

    def frame_time(self, time_s: float) -> float:
        """What `frame_deltas` takes for a time: its `tau`."""
        return self.tau(time_s)

    def frame_deltas(self, gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Callable[[Tensor], Tensor]:
        """From the float32 tau [1] on the field's device to what the field adds then, in the frame path's layout [N, 16].

        No autograd graph. The function reads the field's parameters of the moment; they do not depend on `gaussians`, nor is anything
        computed in another `dtype`.
        """
        if gaussians.count != self.count:
            raise InvalidInput(f"the field holds bumps for {self.count} Gaussians, got {gaussians.count}")

        def at(tau: Tensor) -> Tensor:
            parameters = (p.data for p in self._parameters_in_order())
            return cast(Tensor, self._ops.basis_field(*parameters, tau, padded=True))

        return at if self.continuation is None else self.continuation.captured(at)

    def scale_positions(self, factor: Tensor) -> None:
        """See `DeformationField.scale_positions`; Adam's moments follow."""
        count, each = len(factor), factor[:, None, None]
        self.weights.data[:count, :, POSITION] *= each
        if self._moments is not None:
            self._moments.first[2][:count, :, POSITION] /= each
            self._moments.second[2][:count, :, POSITION] /= each.square()

    def continue_with(self, velocity: Tensor, from_s: float, horizon_s: float) -> None:
        """See `DeformationField.continue_with`."""
        continuation = Continuation(self.count, self.weights.device)
        continuation.write(velocity, from_s, horizon_s)
        continuation.set_clock(self.tau, self._spacing_s)
        self.continuation = continuation

    def move_at(self, time_s: float, change: Tensor) -> bool:
        """See `DeformationField.move_at`: each bump's weight changes in proportion to its height then, the smallest change that does it."""
        with torch.no_grad():
            shifted_bumps_(self.centers.data, self.log_widths.data, self.weights.data, self.tau(time_s), change)
        return True

    def training_tensors(self) -> tuple[Tensor, ...]:
        """Everything that `adam_step_at` changes: parameters, both moments of each, updates per bump. Made where they are not yet.

        A captured CUDA graph is valid as long as these are the same tensors.
        """
        moments = self._moments_in_use()
        return *(p.data for p in self._parameters_in_order()), *moments.first, *moments.second, moments.steps

    def extend(self, time_window_s: tuple[float, float], *, hold_at_s: float | None = None) -> None:
        """Move the window on: new bumps at the head, and bumps that ended before the new start dropped.

        The start and the end may only grow. New bumps start still (zero weights), or so that they continue the deformation at
        `hold_at_s`: tissue that a tool hides then stays as it was last seen, instead of falling back to its canonical state.
        Past the window the field holds its last state. A bump is dropped when its laid-out place is more than 4 spacings before
        the new start.
        """
        start, end = checked_window(time_window_s)
        if start < self._time_window_s[0] or end < self._time_window_s[1]:
            raise InvalidInput(f"the window {self._time_window_s} can only move forward, got {(start, end)}")
        spacing = self._spacing_s
        added, dropped = columns_to_change((start, end), self._origin_s, spacing, self.bumps)
        if added:
            self._append_columns(added, None if hold_at_s is None else self.deltas(hold_at_s).detach())
        if dropped:
            self._set_parameters(*(p.data[:, dropped:] for p in self._parameters_in_order()))
            self.centers.data -= dropped
            self._change_moments(lambda t: t[:, dropped:].contiguous())
            self._origin_s += dropped * spacing
        self._time_window_s = (start, end)

    def select(self, index: Tensor) -> None:
        """Keep the bumps of the Gaussians in `index`."""
        self._set_parameters(*(p.data[index] for p in self._parameters_in_order()))
        self._change_moments(lambda t: t[index])

    def append(self, added: int | Gaussians, parents: Tensor | None = None) -> None:
        """Add still bumps for new Gaussians, or copies of the bumps of `parents`; their Adam state starts afresh."""
        count = count_of(added)
        if parents is not None:
            if parents.shape != (count,):
                raise InvalidInput(f"parents must be [{count}], one for each new Gaussian, got {list(parents.shape)}")
            new = [p.data[parents] for p in self._parameters_in_order()]
        else:
            columns = laid_out(self.bumps, self._spare, self.centers)
            still = (p.data.new_zeros(count, *p.shape[1:]) for p in (self.log_widths, self.weights))
            new = [columns.repeat(count, 1), *still]
        self._set_parameters(*(torch.cat([p.data, n]) for p, n in zip(self._parameters_in_order(), new, strict=True)))
        self._change_moments(lambda t: torch.cat([t, t.new_zeros(count, *t.shape[1:])]))

    def config(self) -> dict[str, Any]:
        """Kind, window and the layout of the columns."""
        return {
            "kind": self.kind,
            "time_window_s": list(self._time_window_s),
            "bumps": self.bumps,
            "channels": BASIS_CHANNELS,
            "origin_s": self._origin_s,
            "spacing_s": self._spacing_s,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any], gaussians: Gaussians) -> BasisField:
        """An untrained field with the columns that `config` describes."""
        start, end = config["time_window_s"]
        field = cls(gaussians.count, (start, end), bumps=config["bumps"])
        field._origin_s, field._spacing_s = float(config["origin_s"]), float(config["spacing_s"])
        return field

    def detached_copy(self) -> Self:
        """See `DeformationField.detached_copy`; without spare columns."""
        copied = super().detached_copy()
        copied._set_parameters(*(p.data[:, : self.bumps] for p in copied._parameters_in_order()))
        copied._spare = 0
        return copied

    def cover(self, time_s: float, newest_s: float) -> None:
        """Keep `COLUMNS_AHEAD` columns ahead of `time_s`, and one beyond; new ones continue the deformation at `newest_s`."""
        ahead_s = COLUMNS_AHEAD * self._spacing_s
        if time_s + ahead_s > self._time_window_s[1]:
            self.extend((self._time_window_s[0], time_s + ahead_s + self._spacing_s), hold_at_s=newest_s)

    def _training_state(self) -> Sequence[object]:
        return (self._moments,)

    def _append_columns(self, added: int, held: Tensor | None) -> None:
        first = self.bumps
        end = first + added
        if added > self._spare:
            self._add_spare((end if self.weights.is_cpu else bump_capacity(end)) - first - self._spare)
        self._spare -= added
        self.centers.data[:, first:end] = laid_out(end, 0, self.centers.data)[first:]
        if held is not None:
            self.weights.data[:, first:end] += held[:, None] / BUMPS_PER_SPACING

    def _add_spare(self, added: int) -> None:
        widened = (with_columns(p.data, added, v) for p, v in zip(self._parameters_in_order(), INERT, strict=True))
        self._set_parameters(*widened)
        self._change_moments(lambda t: with_columns(t, added))
        self._spare += added

    @property
    def _ops(self) -> ModuleType:
        return ops_for(self.weights, compiled, plain_torch)

    def _moments_in_use(self) -> Moments:
        if self._moments is None:
            self._moments = Moments.zeros([p.data for p in self._parameters_in_order()])
        return self._moments

    def _parameters_in_order(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.centers, self.log_widths, self.weights

    def _set_parameters(self, centers: Tensor, log_widths: Tensor, weights: Tensor) -> None:
        """New parameters of other sizes; an optimiser that holds the old ones must be given the new ones."""
        requires_grad = self.weights.requires_grad
        self.centers = torch.nn.Parameter(centers.contiguous(), requires_grad)
        self.log_widths = torch.nn.Parameter(log_widths.contiguous(), requires_grad)
        self.weights = torch.nn.Parameter(weights.contiguous(), requires_grad)

    def _change_moments(self, change: Callable[[Tensor], Tensor]) -> None:
        if self._moments is not None:
            self._moments = self._moments.map(change)
