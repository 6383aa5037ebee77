"""A decoded picture, and whether all of it is what was recorded."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DEPENDS = "it may depend on a damaged frame"
"""How the damage of a picture begins that was decoded without error, from pictures with errors."""


@dataclass(frozen=True)
class Picture:
    """One decoded picture."""

    image: NDArray[np.uint8]
    """RGB uint8 [H, W, 3]."""
    damage: str | None = None
    """Why some of it may be the decoder's guess; None for a picture that was decoded without any sign of damage."""


class DamagedFrames:
    """Which frames of a recording are damaged, as runs of frame numbers: the first `MAX_RUNS` of them, and how many in all."""

    MAX_RUNS = 20

    def __init__(self, numbers: Iterable[int] = ()) -> None:
        self.count = 0
        self._runs: list[tuple[int, int]] = []
        self._more = False
        for number in numbers:
            self.add(number)

    def add(self, number: int) -> None:
        """One more damaged frame; numbers rise."""
        self.count += 1
        if self._runs and self._runs[-1][1] == number - 1 and not self._more:
            self._runs[-1] = self._runs[-1][0], number
        elif len(self._runs) < self.MAX_RUNS:
            self._runs.append((number, number))
        else:
            self._more = True

    def numbers(self) -> str:
        """The numbers, as in `3, 7-12`."""
        runs = [str(first) if first == last else f"{first}-{last}" for first, last in self._runs]
        return ", ".join(runs + ["…"] * self._more)

    def sentence(self, frames: int) -> str:
        """What a reader of the results must know."""
        are = "frame is" if self.count == 1 else "frames are"
        return (
            f"{self.count} of {frames} {are} damaged ({self.numbers()}): shown, but neither trained on nor scored; "
            "`intrasplat validate` says what was found"
        )
