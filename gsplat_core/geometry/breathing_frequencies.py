"""Search for the breathing and heart frequencies of tissue when the scope's trajectory is unknown
as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsplat_core.geometry.moving_bundle import MovingBundle, adjust, with_waves
from gsplat_core.geometry.trajectory_prior import TrajectoryPrior
from gsplat_core.threads import one_thread

BREATHING_HZ, HEART_HZ = (0.1, 0.8), (0.8, 3.0)
LEAST_CYCLES, FEWEST_TRIED = 1.5, 0.5
"""Breathing cycles that the recording must contain for a frequency to be accepted, and to be tried.
A smooth scope trajectory explains less than `LEAST_CYCLES` equally well. Slower frequencies are
still tried, because otherwise their double would win.
"""
STEP_CYCLES = 0.25
"""Spacing of the tried breathing frequencies, in cycles over the recording; twice that for the
heart.
"""
SPREAD = 0.007
"""Cauchy scale of ray errors (x / z)."""
ROUNDS = 2
UNEXPLAINED = 1.0
"""Mean robust cost per observation below which the static model is sufficient. Observations with
only the expected noise cost 0.5 to 1.
"""
BREATHES, BEATS = 0.75, 0.94
"""Largest accepted ratio of the cost with a frequency to the reference cost. The reference of
breathing is the static model. The reference of the heart is the median over all tried heart
frequencies, because any extra frequency lowers the cost a little.
"""


@dataclass(frozen=True)
class _Try:
    """Result of adjusting the bundle with one set of frequencies."""

    hz: tuple[float, ...]
    bundle: MovingBundle
    cost: float


def waves(times_s: Tensor, frequencies_hz: Sequence[float]) -> Tensor:
    """Return cosine and sine of each frequency at each time, [T, 2 F]."""
    angles = 2 * torch.pi * times_s[:, None] * torch.tensor(frequencies_hz, dtype=times_s.dtype)
    return torch.stack([angles.cos(), angles.sin()], 2).flatten(1)


@one_thread()
def frequencies_of(start: MovingBundle, times_s: Tensor, fastest_hz: float = HEART_HZ[1]) -> tuple[float, ...]:
    """Find the frequencies that best explain the observations.

    Args:
        start: static bundle (no motion amplitudes).
        times_s: float64 [T], time of each camera in seconds.
        fastest_hz: upper limit of the search in Hz, set by the frame rate.

    Returns:
        The breathing frequency, the breathing and heart frequencies, or an empty tuple if static
            tissue explains the observations nearly as well.
    """
    length_s = float(times_s[-1] - times_s[0])
    step = STEP_CYCLES / length_s
    still, cost = adjust(start, SPREAD, 3 * ROUNDS)
    slowest = max(BREATHING_HZ[0], FEWEST_TRIED / length_s)
    breaths = [
        _tried(still, times_s, (hz,), ROUNDS) for hz in _between(slowest, min(BREATHING_HZ[1], fastest_hz), step)
    ]
    if cost < UNEXPLAINED * len(start.point) or not breaths or (best := _best(breaths)).cost > BREATHES * cost:
        return ()
    if best.hz[0] * length_s < LEAST_CYCLES:
        return ()
    # One step per heart frequency is enough, since the bundle is already adjusted for breathing.
    beats = [
        _tried(best.bundle, times_s, (*best.hz, hz), 1)
        for hz in _between(HEART_HZ[0], min(HEART_HZ[1], fastest_hz), 2 * step)
    ]
    alone = _tried(best.bundle, times_s, best.hz, 1)
    usual = float(np.median([each.cost for each in beats])) if beats else 0.0
    best = _best([alone, *(each for each in _local_minima(beats) if each.cost < BEATS * usual)])
    bundle, hz = best.bundle, best.hz
    for part in (1.0, 0.5, 0.25, 0.125):
        bundle, hz = sharpened(bundle, times_s, hz, part * STEP_CYCLES, SPREAD)
    return hz


def sharpened(
    bundle: MovingBundle,
    times_s: Tensor,
    hz: tuple[float, ...],
    cycles: float,
    spread: float,
    prior: TrajectoryPrior | None = None,
) -> tuple[MovingBundle, tuple[float, ...]]:
    """Refine each frequency in turn by comparing it with its neighbours at ± `cycles`.

    Args:
        bundle: bundle adjusted with the frequencies `hz`.
        times_s: float64 [T], time of each camera in seconds.
        hz: frequencies to refine, in Hz.
        cycles: distance of the neighbours, in cycles over the recording.
        spread: Cauchy scale of ray errors.
        prior: prior of the scope's trajectory.

    Returns:
        The bundle after one adjustment step per frequency, and the refined frequencies in Hz.
    """
    part = cycles / float(times_s[-1] - times_s[0])
    for which in range(len(hz)):
        around = [_changed(hz, which, change) for change in (-part, 0.0, part)]
        best = _best([_tried(bundle, times_s, each, 1, spread, prior) for each in around])
        bundle, hz = best.bundle, best.hz
    return bundle, hz


def _tried(
    start: MovingBundle,
    times_s: Tensor,
    hz: tuple[float, ...],
    rounds: int,
    spread: float = SPREAD,
    prior: TrajectoryPrior | None = None,
) -> _Try:
    """Adjust a start bundle that already contains all of these frequencies, or all but the last
    one.
    """
    return _Try(hz, *adjust(with_waves(start, waves(times_s, hz)), spread, rounds, prior))


def _best(tries: Sequence[_Try]) -> _Try:
    return min(tries, key=lambda each: each.cost)


def _local_minima(tries: Sequence[_Try]) -> list[_Try]:
    """Return the tries with a lower cost than both neighbours. A minimum at the end of the band
    belongs to a frequency outside it.
    """
    inner = zip(tries, tries[1:], tries[2:], strict=False)
    return [each for before, each, after in inner if each.cost <= min(before.cost, after.cost)]


def _between(slowest: float, fastest: float, step: float) -> list[float]:
    return [float(hz) for hz in np.arange(slowest, fastest, step)]


def _changed(hz: tuple[float, ...], which: int, change: float) -> tuple[float, ...]:
    return tuple(each + change * (number == which) for number, each in enumerate(hz))
