"""Breathing of synthetic tissue: a phase over time with adjustable symmetry and rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PERIOD_S = 3.4
"""Mean period of a breath, in seconds."""
WANDER_PERIODS_S = (6.1, 9.7)
"""Periods of the two waves that modulate the rate: about two and three breaths."""


@dataclass(frozen=True)
class Breathing:
    """Phase of breathing over time. Its sine has the minimum at -pi/2 and the maximum at pi/2."""

    start: float
    """Phase at time 0, before the asymmetry is applied."""
    ratio: float = 1.0
    """Expiration to inspiration ratio: duration of the falling half over that of the rising half."""
    wander: float = 0.0
    """Largest relative deviation of the rate."""
    wander_phases: tuple[float, float] = (0.0, 0.0)

    def phase(self, time_s: float) -> float:
        """Return the phase at `time_s` in radians; continuous and increasing."""
        uniform = 2 * np.pi * time_s / PERIOD_S + self.start
        if self.wander:
            uniform += 2 * np.pi / PERIOD_S * self.wander * self._ahead_s(time_s)
        return float(uniform) if self.ratio == 1 else unequal(float(uniform), self.ratio)

    def _ahead_s(self, time_s: float) -> float:
        """Return the time lead per unit of `wander`: the integral of a deviation between -1 and 1."""
        waves = (
            period / (2 * np.pi) * (np.sin(2 * np.pi * time_s / period + phase) - np.sin(phase))
            for period, phase in zip(WANDER_PERIODS_S, self.wander_phases, strict=True)
        )
        return float(sum(waves)) / len(WANDER_PERIODS_S)


def unequal(phase: float, ratio: float) -> float:
    """Map a uniform phase to one whose sine falls `ratio` times as long as it rises.

    The map is smooth and preserves multiples of pi: tan(after / 2) = k tan(before / 2). The rising
    half takes 2 atan(1 / k) of a turn of 2 pi.
    """
    k = 1 / np.tan(np.pi / 2 / (1 + ratio))
    turns = round(phase / (2 * np.pi))
    half = phase / 2 - np.pi * turns
    return float(2 * np.pi * turns + 2 * np.arctan2(k * np.sin(half), np.cos(half)))
