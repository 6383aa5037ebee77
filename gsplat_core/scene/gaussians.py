"""Set of 3D Gaussians in the raw parametrisation that is optimised, and the layout of rows [N, 16] of raw parameters.

Raw parameters are those that the optimiser changes: log-scales, opacity logits, and the coefficient of the constant
spherical harmonic as colour. Rows [N, 16] hold deformation deltas and their gradients.
`gsplat_core/native/raw_layout.h` defines the same layout for the kernels.

For captured CUDA graphs, which hold addresses and sizes, Gaussians can be stored in the first rows of preallocated tensors
with the capacity of the largest scene. Rows after those in use are inert: their opacity is 0, they are in no tile list, and
they receive no gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput

MAX_SH_DEGREE = 4
SH_C0 = 0.28209479177387814
"""The constant basis function Y00 = 1 / (2 sqrt(pi)); a colour c has the coefficient (c - 0.5) / SH_C0."""
EXTRA_PREFIX = "extra."
"""Prefix that `Gaussians.tensors` puts before the names of the tensors in `Gaussians.extra`."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians (Kerbl et al. 2023, section 4); all tensors have one dtype and device.

    Raises:
        InvalidInput: if shapes, dtypes or devices are inconsistent.
    """

    means: Tensor
    """Centres [N, 3], world units."""
    quats: Tensor
    """Rotations [N, 4] as wxyz; need not be of unit length."""
    log_scales: Tensor
    """Natural logarithms of the standard deviations along the principal axes [N, 3]."""
    logit_opacities: Tensor
    """Logit of the opacities [N]."""
    sh: Tensor
    """Spherical-harmonics coefficients [N, K, 3], K = (degree + 1)²; the colour is their sum plus 0.5, at least 0."""
    right_sh: Tensor | None = None
    """Difference of the right eye's SH coefficients to `sh`, same shape; None for equal colours."""
    extra: Mapping[str, Tensor] = field(default_factory=dict)
    """Further parameters [N, ...] of a renderer or output by name, such as the logits of semantic classes."""

    def __post_init__(self) -> None:
        for name, value in self.tensors().items():
            if not isinstance(value, Tensor):
                raise InvalidInput(
                    f"gaussians: {name} must be a tensor, got {type(value).__name__}; convert it by torch.as_tensor"
                )
        n = self.means.shape[0] if self.means.dim() else -1
        expected = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,)}
        for name, shape in expected.items():
            seen = tuple(getattr(self, name).shape)
            if seen != shape:
                wanted = ", ".join(["N", *map(str, shape[1:])])
                raise InvalidInput(f"gaussians: {name} must be [{wanted}] with N = {n}, got {list(seen)}")
        bases = [(degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1)]
        if self.sh.dim() != 3 or self.sh.shape[0] != n or self.sh.shape[1] not in bases or self.sh.shape[2] != 3:
            raise InvalidInput(
                f"gaussians: sh must be [N, K, 3] with N = {n} and K one of {bases}, got {list(self.sh.shape)}"
            )
        if self.right_sh is not None and self.right_sh.shape != self.sh.shape:
            raise InvalidInput(
                f"gaussians: right_sh must be {list(self.sh.shape)} as sh is, got {list(self.right_sh.shape)}"
            )
        for name, tensor in self.extra.items():
            if not tensor.dim() or tensor.shape[0] != n:
                raise InvalidInput(f"gaussians: extra {name!r} must be [N, ...] with N = {n}, got {list(tensor.shape)}")
        kinds = {(tensor.dtype, tensor.device) for tensor in self.tensors().values()}
        if len(kinds) != 1 or not self.means.is_floating_point():
            found = {name: f"{t.dtype} on {t.device}" for name, t in self.tensors().items()}
            raise InvalidInput(f"gaussians: all tensors must have one floating-point dtype and one device, got {found}")

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.means.shape[0])

    def __len__(self) -> int:
        return self.count

    @property
    def sh_degree(self) -> int:
        """Highest degree of the spherical harmonics, 0 to 4."""
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def scales(self) -> Tensor:
        """Standard deviations [N, 3], world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities [N] in 0..1."""
        # torch.sigmoid rounds differently at the ends of each thread's part of the tensor. The equivalent
        # tanh form does not.
        return 0.5 + 0.5 * torch.tanh(0.5 * self.logit_opacities)

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def dtype(self) -> torch.dtype:
        return self.means.dtype

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by field name: five, plus `right_sh` if present, plus `extra.NAME` of each extra tensor."""
        right = {} if self.right_sh is None else {"right_sh": self.right_sh}
        return {
            "means": self.means,
            "quats": self.quats,
            "log_scales": self.log_scales,
            "logit_opacities": self.logit_opacities,
            "sh": self.sh,
            **right,
            **{EXTRA_PREFIX + name: tensor for name, tensor in self.extra.items()},
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Gaussians:
        """Create Gaussians from tensors named as in `tensors()`."""
        own = {name: tensor for name, tensor in tensors.items() if not name.startswith(EXTRA_PREFIX)}
        extra = {name.removeprefix(EXTRA_PREFIX): tensors[name] for name in tensors if name not in own}
        return cls(**own, extra=extra)

    @property
    def left_tensors(self) -> tuple[Tensor, ...]:
        """Tensors from which a picture is rendered: the first five, in field order."""
        return self.means, self.quats, self.log_scales, self.logit_opacities, self.sh

    def seen_by_right(self) -> Gaussians:
        """Return the Gaussians with the right eye's colours in `sh`; itself without `right_sh`."""
        return self if self.right_sh is None else replace(self, sh=self.sh + self.right_sh, right_sh=None)

    def with_right(self, wanted: bool = True) -> Gaussians:
        """Return the Gaussians with the tensor `right_sh` (zeros if missing) if `wanted`, otherwise without it."""
        if (self.right_sh is not None) == wanted:
            return self
        return replace(self, right_sh=torch.zeros_like(self.sh) if wanted else None)

    def like(self, other: Gaussians) -> Gaussians:
        """Return the Gaussians with the same optional tensors as `other`: missing ones are added as zeros, additional ones left out."""
        extra = {
            name: self.extra.get(name, tensor.new_zeros(self.count, *tensor.shape[1:]))
            for name, tensor in other.extra.items()
        }
        return replace(self.with_right(other.right_sh is not None), extra=extra)

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Return the Gaussians with `function` applied to each tensor."""
        return Gaussians.from_tensors({name: function(tensor) for name, tensor in self.tensors().items()})

    def detach(self) -> Gaussians:
        """Return the Gaussians detached from the autograd graph, sharing memory."""
        return self.map(Tensor.detach)

    def clone(self) -> Gaussians:
        """Return a copy in separate memory, still attached to the autograd graph."""
        return self.map(Tensor.clone)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """Return the Gaussians on another device or in another floating dtype."""
        return self.map(lambda tensor: tensor.to(device=device, dtype=dtype))

    def requires_grad_(self, requires_grad: bool = True) -> Gaussians:
        """Enable or disable gradients of all tensors; returns self."""
        for tensor in self.tensors().values():
            tensor.requires_grad_(requires_grad)
        return self

    def select(self, index: Tensor | slice) -> Gaussians:
        """Select Gaussians by mask [N], index tensor or slice."""
        return self.map(lambda tensor: tensor[index])

    def append(self, other: Gaussians) -> Gaussians:
        """Concatenate these Gaussians and `other`.

        `right_sh` and `extra` are kept if these Gaussians have them; missing values of `other` become 0.

        Raises:
            InvalidInput: if SH degree, dtype, device or the shape of an extra tensor differ.
        """
        if other.sh_degree != self.sh_degree:
            raise InvalidInput(f"gaussians: cannot append SH degree {other.sh_degree} to degree {self.sh_degree}")
        if (other.dtype, other.device) != (self.dtype, self.device):
            raise InvalidInput(
                f"gaussians: cannot append {other.dtype} on {other.device} to {self.dtype} on {self.device}"
            )
        for name, tensor in self.extra.items():
            added = other.extra.get(name, tensor)
            if added.shape[1:] != tensor.shape[1:]:
                raise InvalidInput(
                    f"gaussians: cannot append extra {name!r} {list(added.shape)} to {list(tensor.shape)}; only the number of"
                    " rows may differ"
                )
        theirs = other.like(self).tensors()
        return Gaussians.from_tensors(
            {name: torch.cat([tensor, theirs[name]]) for name, tensor in self.tensors().items()}
        )


def require_gaussians(function: str, value: object) -> None:
    """Raise InvalidInput unless an argument of the public function `function` is `Gaussians`."""
    if not isinstance(value, Gaussians):
        raise InvalidInput(
            f"{function} takes Gaussians, got {type(value).__name__}; a Model gives them by at(time_s), a GaussianCollection as"
            " gaussians"
        )


RAW_COLUMNS = 16
"""Number of columns of a raw row. Columns beyond `OPACITY` are unused and zero, so that a row is four aligned float4.
"""
POSITION = slice(0, 3)
"""Columns of the position delta x, y, z in a raw row."""
ROTATION = slice(3, 7)
"""Columns of the quaternion delta w, x, y, z in a raw row."""
LOG_SCALE = slice(7, 10)
COLOUR = slice(10, 13)
"""Columns of the delta of the degree-0 spherical-harmonics coefficient: red, green, blue."""
OPACITY = slice(13, 14)
"""Column of the opacity-logit delta in a raw row."""


def width_of(*groups: slice) -> int:
    """Return the total number of columns of groups of raw parameters, such as `POSITION` and `ROTATION`."""
    return sum(group.stop - group.start for group in groups)


@dataclass(frozen=True)
class RowMoves:
    """Moves of tensor rows that keep the rows of the remaining Gaussians contiguous after removals.

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
        """Return the moves as a gather index int64 [count]: for each row after the moves, the row that its values come from."""
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
        """Gaussians in all rows up to the capacity; CUDA graphs hold the addresses of these tensors."""
        self.used = self.all
        """Gaussians in the rows in use, as views of the tensors of `all`."""
        self.replace(gaussians)

    @property
    def capacity(self) -> int:
        """Largest number of Gaussians that the tensors can hold."""
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
        """Return pairs of tensors: each tensor of the rows in use, and the tensor of the same name of `others`."""
        others = others.like(self.used)
        return zip(self.used.tensors().values(), others.tensors().values(), strict=True)

    def _use(self, count: int) -> None:
        if count > self.capacity:
            raise InvalidInput(f"{count} Gaussians do not fit into {self.capacity} rows")
        self.used = self.all.map(lambda tensor: tensor[:count])

    def _make_inert(self, first: int) -> None:
        self.all.quats[first:, 0] = 1
        self.all.logit_opacities[first:] = -math.inf


def rotations(quats: Tensor) -> Tensor:
    """Convert quaternions [N, 4] (wxyz, any non-zero length) to rotation matrices [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
