"""Whether a scope's own trajectory can be told from breathing: what the prior of the trajectory takes for the tissue's at the breathing's frequency, and what it would take at those beside it.

The prior gives the tissue what of a line at its frequency a smooth trajectory does not have (`trajectory_prior`). Half a cycle of the recording to either side the tissue has no line: what would
be given to it there is the scope's own, and as much may be wrong at the breathing's frequency. Where the scope swings nearly as fast as the tissue breathes, both sides show it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.geometry.breathing_frequencies import waves
from gsplat_core.geometry.trajectory_prior import PLACES, TrajectoryPrior, coordinates, learned_from
from gsplat_core.threads import one_thread

BESIDE_CYCLES = 0.5
"""From the breathing's frequency to those beside it, in cycles over the recording."""
CLEARLY = 2.0
"""What is given to the tissue has to be so many times what would be given to it beside its frequency, or poses may get worse by it."""


@one_thread()
def is_told(before: Tensor, poses: Tensor, times_s: Tensor, hz: Sequence[float]) -> tuple[bool, float]:
    """Whether `poses` [C, 4, 4], from which breathing was taken, are to be believed more than those `before`; and how much of them may be the tissue's (root mean square)."""
    length_s = float(times_s[-1] - times_s[0])
    apart = BESIDE_CYCLES / length_s
    beside = [(hz[0] + change, *hz[1:]) for change in (-apart, apart)]
    mistaken = min(_given_to_tissue(poses, poses, times_s, each) for each in beside)
    return _given_to_tissue(before, poses, times_s, hz) > CLEARLY * mistaken, mistaken


def _given_to_tissue(poses: Tensor, like: Tensor, times_s: Tensor, hz: Sequence[float]) -> float:
    """How far (root mean square) places swing at the first frequency by more than a trajectory like `like` may."""
    swings = waves(times_s, hz)
    prior = learned_from(like, times_s, swings)
    y, _ = coordinates(poses)
    part = torch.stack([_line(prior, swings, y[:, axis], axis) for axis in range(PLACES.stop)], 1)
    return float((part - part.mean(0)).square().sum(1).mean().sqrt())


def _line(prior: TrajectoryPrior, swings: Tensor, y: Tensor, axis: int) -> Tensor:
    """The first frequency's part of a coordinate [C], by generalised least squares."""
    pushed = swings.T @ prior.precision[axis]
    return swings[:, :2] @ torch.linalg.solve(pushed @ swings, pushed @ y)[:2]
