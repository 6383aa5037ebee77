"""Test of whether the scope's own motion can be separated from breathing.

The trajectory prior attributes to the tissue the part of a motion at the breathing frequency that a
smooth trajectory does not have (`trajectory_prior`). At neighbouring frequencies, half a cycle per
recording away, the tissue has no motion. Anything attributed to it there is scope motion, and an
error of the same size is expected at the breathing frequency. A scope that moves nearly as fast as
the tissue breathes shows at both neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.geometry.breathing_frequencies import waves
from gsplat_core.geometry.trajectory_prior import PLACES, TrajectoryPrior, coordinates, learned_from
from gsplat_core.threads import one_thread

BESIDE_CYCLES = 0.5
"""Distance of the neighbouring frequencies, in cycles over the recording."""
CLEARLY = 2.0
"""Smallest ratio of the motion attributed to the tissue to that at the neighbouring frequencies;
below it poses may get worse.
"""


@one_thread()
def is_told(before: Tensor, poses: Tensor, times_s: Tensor, hz: Sequence[float]) -> tuple[bool, float]:
    """Compare the motion attributed to the tissue with its expected error.

    Args:
        before: poses estimated for static tissue [C, 4, 4].
        poses: poses after separating the breathing [C, 4, 4].
        times_s: times in seconds [C].
        hz: breathing frequency, and heart frequency if found.

    Returns:
        True if `poses` are more reliable than `before`, and the root mean square scope motion that
            may be attributed to the tissue.
    """
    length_s = float(times_s[-1] - times_s[0])
    apart = BESIDE_CYCLES / length_s
    beside = [(hz[0] + change, *hz[1:]) for change in (-apart, apart)]
    mistaken = min(_given_to_tissue(poses, poses, times_s, each) for each in beside)
    return _given_to_tissue(before, poses, times_s, hz) > CLEARLY * mistaken, mistaken


def _given_to_tissue(poses: Tensor, like: Tensor, times_s: Tensor, hz: Sequence[float]) -> float:
    """Return the root mean square motion at the first frequency beyond that of a trajectory like
    `like`.
    """
    swings = waves(times_s, hz)
    prior = learned_from(like, times_s, swings)
    y, _ = coordinates(poses)
    part = torch.stack([_line(prior, swings, y[:, axis], axis) for axis in range(PLACES.stop)], 1)
    return float((part - part.mean(0)).square().sum(1).mean().sqrt())


def _line(prior: TrajectoryPrior, swings: Tensor, y: Tensor, axis: int) -> Tensor:
    """Return the first frequency's part of a coordinate [C] by generalised least squares."""
    pushed = swings.T @ prior.precision[axis]
    return swings[:, :2] @ torch.linalg.solve(pushed @ swings, pushed @ y)[:2]
