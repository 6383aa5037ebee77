"""How much of a sequence's change each part of a model's deformation carries: motion, colour, or opacity and size.

A model that repaints tissue instead of moving it shows the right pictures and knows nothing of how tissue moves. So frames are rendered with
parts of the deformation frozen at a reference time, from the frame's own pose. A part's share is its Shapley value: how much its
thawing lowers the squared difference to the recorded picture, averaged over the orders in which the parts can be thawed. The shares sum to
what the whole deformation explains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from math import factorial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians

MOTION, COLOUR, SIZE = "motion", "colour", "size"
PARTS: dict[str, tuple[str, ...]] = {
    MOTION: ("means", "quats"),
    COLOUR: ("sh",),
    SIZE: ("log_scales", "logit_opacities"),
}
"""The tensors of `Gaussians` that each part changes."""
MOST_FRAMES = 8
"""Frames that are looked at: each is rendered eight times."""


@dataclass(frozen=True)
class PartShares:
    """Shares of the squared change of the recorded pictures against the model frozen at `reference_s`, over tissue."""

    motion: float
    """Positions and orientations of Gaussians."""
    colour: float
    size: float
    """Sizes and opacities."""
    explained: float
    """The sum: of the whole deformation. The rest is what no part explains."""
    reference_s: float
    frames: int


class PartSums:
    """Takes frames one at a time."""

    def __init__(self, gaussians_at: Callable[[float], Gaussians], reference_s: float) -> None:
        """gaussians_at: the deformed Gaussians of a model. reference_s: when the frozen parts are taken from."""
        self._at, self._reference_s = gaussians_at, reference_s
        self._errors: dict[frozenset[str], float] = {thawed: 0.0 for thawed in _subsets(tuple(PARTS))}
        self._frames = 0

    def add(self, frame: Frame, picture_of: Callable[[Gaussians], NDArray[Any]]) -> None:
        """Render a frame with each choice of parts thawed. picture_of: its picture of Gaussians, [H, W, 3] in 0..1, from its own pose."""
        moved, frozen = self._at(frame.time_s).tensors(), self._at(self._reference_s).tensors()
        tissue = np.ones(frame.image.shape[:2], bool) if frame.mask is None else frame.mask != 0
        wanted = frame.image[tissue].astype(np.float64) / 255
        for thawed in self._errors:
            names = {name for part in thawed for name in PARTS[part]}
            mixed: dict[str, Tensor] = {name: (moved if name in names else frozen)[name] for name in moved}
            shown = picture_of(Gaussians(**mixed))[tissue].astype(np.float64)
            self._errors[thawed] += float(np.square(shown - wanted).sum())
        self._frames += 1

    @property
    def shares(self) -> PartShares | None:
        """What they come to; None where nothing changes."""
        whole = self._errors[frozenset()]
        if not self._frames or whole <= 0:
            return None
        shares = {part: self._shapley(part) / whole for part in PARTS}
        return PartShares(
            shares[MOTION], shares[COLOUR], shares[SIZE], sum(shares.values()), self._reference_s, self._frames
        )

    def _shapley(self, part: str) -> float:
        others = tuple(name for name in PARTS if name != part)
        count = len(PARTS)
        return sum(
            factorial(len(before))
            * factorial(count - len(before) - 1)
            / factorial(count)
            * (self._errors[before] - self._errors[before | {part}])
            for before in _subsets(others)
        )


def _subsets(names: tuple[str, ...]) -> list[frozenset[str]]:
    return [frozenset(chosen) for size in range(len(names) + 1) for chosen in combinations(names, size)]
