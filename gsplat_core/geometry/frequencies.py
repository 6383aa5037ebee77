"""Search for the breathing and heart frequencies of tissue seen by a scope with known poses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gsplat_core.geometry.grid_tracks import GridTracks
from gsplat_core.geometry.periodic_motion import Array, PeriodicMotion, fitted

BREATHING_HZ = 0.1, 0.8
HEART_HZ = 0.8, 3.0
LEAST_CYCLES = 0.6
"""Fewest cycles over the recording of the slowest frequency tried; slower motion cannot be
distinguished from drift.
"""
STEP_CYCLES = 0.25
"""Spacing of the tried frequencies in cycles over the recording; closer ones are indistinguishable.
"""
COARSE, FINE = (5, 5), (8, 7)
"""Node counts of the motion fits used for comparison: in the coarse search and near the optimum."""
POINTS, TIMES = 400, 48
"""Numbers of points and times used for the search."""
ROUNDS = 4
BREATHES, BEATS = 0.9, 0.96
"""Largest ratio of the robust cost with a frequency to the cost without, from which breathing and
heart beat are accepted.
"""
AS_GOOD = 1.06
"""Ratio to the lowest cost up to which another frequency counts as equally plausible."""


@dataclass(frozen=True)
class Frequencies:
    """Frequencies of the tissue's motion, with the uncertainty of the depth."""

    hz: tuple[float, ...]
    """Empty for static tissue, otherwise the breathing frequency, or the breathing and heart
    frequencies.
    """
    error: float
    """Relative change of the tissue's depth between equally plausible frequencies."""


def found_in(tracks: GridTracks) -> Frequencies:
    """Find the frequencies that best explain the tracks; none if static tissue explains them nearly
    as well.
    """
    few = _few(tracks)
    still = fitted(few, (), rounds=2 * ROUNDS, nodes=COARSE)
    rest = still.terms[:, :, 0]
    length_s = float(few.times_s[-1] - few.times_s[0])
    step = STEP_CYCLES / length_s
    slowest = max(BREATHING_HZ[0], LEAST_CYCLES / length_s)
    tried = [_tried(few, (hz,), rest) for hz in _between((slowest, BREATHING_HZ[1]), step)]
    if not tried or (best := _best(tried)).cost > BREATHES * still.cost:
        return Frequencies((), 0.0)
    fastest = min(HEART_HZ[1], 0.4 / float(np.median(np.diff(few.times_s))))
    beats = [
        _tried(few, (*best.frequencies_hz, hz), best.terms[:, :, 0]) for hz in _between((HEART_HZ[0], fastest), step)
    ]
    if beats and _best(beats).cost < BEATS * best.cost:
        best = _best(beats)
    best = _tried(few, best.frequencies_hz, best.terms[:, :, 0], FINE)
    around = [best]
    for part in (step / 2, step / 4, step / 8, step / 16):
        for which in range(len(best.frequencies_hz)):
            for change in (-part, part):
                around.append(_tried(few, _changed(best, which, change), best.terms[:, :, 0], FINE))
            best = _best(around)
    return Frequencies(best.frequencies_hz, _spread([*around, best], best, few))


def _few(tracks: GridTracks) -> GridTracks:
    times, points = tracks.seen.shape
    some = np.linspace(0, points - 1, min(POINTS, points)).round().astype(int)
    return tracks.of(some, np.linspace(0, times - 1, min(TIMES, times)).round().astype(int))


def _tried(tracks: GridTracks, hz: tuple[float, ...], rest: Array, nodes: tuple[int, int] = COARSE) -> PeriodicMotion:
    return fitted(tracks, hz, begin=rest, rounds=ROUNDS, nodes=nodes)


def _best(tried: Iterable[PeriodicMotion]) -> PeriodicMotion:
    return min(tried, key=lambda each: each.cost)


def _between(band: tuple[float, float], step: float) -> list[float]:
    return np.arange(band[0], band[1], step).tolist()


def _changed(best: PeriodicMotion, which: int, change: float) -> tuple[float, ...]:
    hz = list(best.frequencies_hz)
    hz[which] = float(np.clip(hz[which] + change, *(BREATHING_HZ, HEART_HZ)[which]))
    return tuple(hz)


def _spread(tried: Iterable[PeriodicMotion], best: PeriodicMotion, tracks: GridTracks) -> float:
    """Return the largest median relative depth difference between the best fit and all equally
    plausible fits.
    """
    pose = tracks.poses[len(tracks.poses) // 2]
    depths = [each.terms[:, :, 0] @ pose[2, :3] + pose[2, 3] for each in tried if each.cost <= AS_GOOD * best.cost]
    return float(max(np.median(np.abs(depth / depths[-1] - 1)) for depth in depths))
