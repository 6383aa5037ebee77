"""At which frequencies tissue breathes and its heart beats, before a scope whose trajectory is not known either."""

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
"""Of breathing: with less of it, a smooth trajectory of the scope does as well. Less is looked for all the same, or its double would be found in its place."""
STEP_CYCLES = 0.25
"""From one frequency that is tried to the next, in cycles over the recording; twice that for the heart."""
SPREAD = 0.007
"""Rays (x / z) that are off by well more than this decide little."""
ROUNDS = 2
UNEXPLAINED = 1.0
"""Cost of an observation from which on there is something to explain: errors as they are expected cost one half to one."""
BREATHES, BEATS = 0.75, 0.94
"""What is left of the cost with a frequency from which on the tissue is taken to move with it: of breathing relative to tissue at rest, of the heart to
the median of all frequencies that are tried, since any explains a little."""


@dataclass(frozen=True)
class _Try:
    """What was found with some frequencies."""

    hz: tuple[float, ...]
    bundle: MovingBundle
    cost: float


def waves(times_s: Tensor, frequencies_hz: Sequence[float]) -> Tensor:
    """Cosine and sine of each frequency [T, 2 F]."""
    angles = 2 * torch.pi * times_s[:, None] * torch.tensor(frequencies_hz, dtype=times_s.dtype)
    return torch.stack([angles.cos(), angles.sin()], 2).flatten(1)


@one_thread()
def frequencies_of(start: MovingBundle, times_s: Tensor, fastest_hz: float = HEART_HZ[1]) -> tuple[float, ...]:
    """Of breathing, or of breathing and the heart, those that explain best where points were seen; none where they explain little more than tissue
    at rest does.

    fastest_hz: what swings faster is seen too seldom to be told from what is slower.
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
    # From here on one step each is enough: all but the new frequency's part is there.
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
    """The bundle after a step for each frequency, with those that are right to about so many cycles over the recording."""
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
    """From a start with all of these frequencies, or with those before the last one."""
    return _Try(hz, *adjust(with_waves(start, waves(times_s, hz)), spread, rounds, prior))


def _best(tries: Sequence[_Try]) -> _Try:
    return min(tries, key=lambda each: each.cost)


def _local_minima(tries: Sequence[_Try]) -> list[_Try]:
    """Those that are better than both neighbours: the best one at an end of the band is the flank of something outside."""
    inner = zip(tries, tries[1:], tries[2:], strict=False)
    return [each for before, each, after in inner if each.cost <= min(before.cost, after.cost)]


def _between(slowest: float, fastest: float, step: float) -> list[float]:
    return [float(hz) for hz in np.arange(slowest, fastest, step)]


def _changed(hz: tuple[float, ...], which: int, change: float) -> tuple[float, ...]:
    return tuple(each + change * (number == which) for number, each in enumerate(hz))
