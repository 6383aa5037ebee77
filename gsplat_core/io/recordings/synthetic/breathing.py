"""The breathing of synthetic tissue: a phase over time, of equal or unequal halves, at a steady or a wandering rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PERIOD_S = 3.4
"""Mean period of a breath, in seconds."""
WANDER_PERIODS_S = (6.1, 9.7)
"""The rate is off by two waves of these periods, of two and of three breaths."""


@dataclass(frozen=True)
class Breathing:
    """The phase of breathing at each time. A sine of it is at its lowest at -pi/2 and at its highest at pi/2."""

    start: float
    """Phase at time 0, before its halves are made unequal."""
    ratio: float = 1.0
    """Duration of the falling half of a breath over that of the rising one (expiration over inspiration)."""
    wander: float = 0.0
    """Largest deviation of the rate, as a share of it."""
    wander_phases: tuple[float, float] = (0.0, 0.0)

    def phase(self, time_s: float) -> float:
        """Return the phase at `time_s` in radians; continuous and increasing."""
        uniform = 2 * np.pi * time_s / PERIOD_S + self.start
        if self.wander:
            uniform += 2 * np.pi / PERIOD_S * self.wander * self._ahead_s(time_s)
        return float(uniform) if self.ratio == 1 else unequal(float(uniform), self.ratio)

    def _ahead_s(self, time_s: float) -> float:
        """Return the time by which breathing is ahead per unit of `wander`: the integral of a deviation between -1 and 1."""
        waves = (
            period / (2 * np.pi) * (np.sin(2 * np.pi * time_s / period + phase) - np.sin(phase))
            for period, phase in zip(WANDER_PERIODS_S, self.wander_phases, strict=True)
        )
        return float(sum(waves)) / len(WANDER_PERIODS_S)


def unequal(phase: float, ratio: float) -> float:
    """Return a phase whose sine falls `ratio` times as long as it rises, for one that advances uniformly. Smooth, and equal at multiples of pi.

    The map is tan(after / 2) = k tan(before / 2); the rising half then takes 2 atan(1 / k) of a turn of 2 pi.
    """
    k = 1 / np.tan(np.pi / 2 / (1 + ratio))
    turns = round(phase / (2 * np.pi))
    half = phase / 2 - np.pi * turns
    return float(2 * np.pi * turns + 2 * np.arctan2(k * np.sin(half), np.cos(half)))
