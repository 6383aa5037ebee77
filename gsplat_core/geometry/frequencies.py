"""At which frequencies tissue moves: breathing and heart beat are looked for in what a moving scope sees of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gsplat_core.geometry.grid_tracks import GridTracks
from gsplat_core.geometry.periodic_motion import Array, PeriodicMotion, fitted

BREATHING_HZ = 0.1, 0.8
HEART_HZ = 0.8, 3.0
LEAST_CYCLES = 0.6
"""Of what is slower, so little is seen that it could be any drift."""
STEP_CYCLES = 0.25
"""From one frequency that is tried to the next, in cycles over the recording: two that differ by less look the same."""
COARSE, FINE = (5, 5), (8, 7)
"""Nodes of the fits that are only compared: at first, and near the best one."""
POINTS, TIMES = 400, 48
"""That are looked at."""
ROUNDS = 4
BREATHES, BEATS = 0.9, 0.96
"""What is left of the robust error with a frequency, relative to without, from which on the tissue is taken to move with it."""
AS_GOOD = 1.06
"""A frequency whose error is not more than so many times the best one's may be the right one."""


@dataclass(frozen=True)
class Frequencies:
    """What was found."""

    hz: tuple[float, ...]
    """None where tissue stands still; breathing; breathing and heart."""
    error: float
    """How much the distance of the tissue would change with frequencies that explain the pictures as well, relative to it."""


def found_in(tracks: GridTracks) -> Frequencies:
    """The frequencies that explain best where points were seen, none where they explain little more than a tissue that stands still does."""
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
    """How much distances of those differ, as a median, that explain the pictures about as well as the best."""
    pose = tracks.poses[len(tracks.poses) // 2]
    depths = [each.terms[:, :, 0] @ pose[2, :3] + pose[2, 3] for each in tried if each.cost <= AS_GOOD * best.cost]
    return float(max(np.median(np.abs(depth / depths[-1] - 1)) for depth in depths))
