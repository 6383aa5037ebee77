"""Trajectories of a moving scope: the usual sway, and drawn paths of several kinds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

PathKind = Literal["hand-held", "translation", "rotation", "insertion"]
PATH_KINDS: tuple[PathKind, ...] = get_args(PathKind)
Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Sway:
    """Trajectory of a moving scope: a sine along each axis and a sinusoidal roll, all 0 at time 0."""

    periods_s: tuple[float, float, float, float] = (4.1, 5.3, 6.7, 4.7)
    """Periods in seconds of the motion along x, y and z, and of the roll."""
    reaches: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Factors on the usual amplitudes along x, y and z, and of the roll."""
    phases: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @classmethod
    def seeded(cls, rng: np.random.Generator) -> Sway:
        """Draw another trajectory: 0.7 to 1.5 times the usual periods, 0.6 to 1.3 times the amplitudes.

        Phases are random.
        """
        periods = np.array(cls.periods_s) * rng.uniform(0.7, 1.5, 4)
        return cls(
            *(tuple(each.tolist()) for each in (periods, rng.uniform(0.6, 1.3, 4), rng.uniform(0, 2 * np.pi, 4)))
        )

    def at(self, time_s: float, sway_mm: tuple[float, float, float]) -> tuple[NDArray[np.float64], float]:
        """Return the centre [3] in mm and the roll in radians, for the usual amplitudes along x, y and z."""
        turn = 2 * np.pi * time_s
        ways = [
            most * reach * (np.sin(turn / period + phase) - np.sin(phase))
            for most, reach, period, phase in zip(
                (*sway_mm, USUAL_ROLL), self.reaches, self.periods_s, self.phases, strict=True
            )
        ]
        return np.array(ways[:3]), float(ways[3])


USUAL_ROLL = 0.05
USUAL_SWAY = Sway()


@dataclass(frozen=True)
class ScopePath:
    """Drawn trajectory: slow motion along and around the three axes with a tremor, all 0 at time 0.

    Six values belong to the translation along x, y and z, and to pan, tilt and roll.
    """

    kind: PathKind
    amplitudes: Six
    """Amplitudes of the slow motion, in mm and radians."""
    periods_s: Six
    phases: Six
    followed: float
    """Share of the translation's effect on the view that the scope's orientation compensates."""
    looked_at_mm: float
    """Distance of the point that the orientation follows, in mm."""
    tremor: Six
    """Amplitudes of the tremor, in mm and radians."""
    tremor_hz: Six
    tremor_phases: Six

    @classmethod
    def drawn(cls, rng: np.random.Generator, kind: PathKind, distance_mm: float) -> ScopePath:
        """Draw a path of a kind in front of tissue at a distance in mm."""
        scale = rng.uniform(0.6, 1.4, 6)
        phases, periods = rng.uniform(0, 2 * np.pi, 6), rng.uniform(4, 10, 6)
        followed = float(rng.uniform(0, 1))
        shares = np.array([0.10, 0.08, 0.08, 0.05, 0.05, 0.08])
        if kind == "translation":
            along = rng.uniform(0, 2 * np.pi)
            shares = np.array([0.28 * np.cos(along), 0.28 * np.sin(along), 0.02, 0.01, 0.01, 0.02])
            periods[:2] = rng.uniform(9, 18)
            phases[:2] = rng.uniform(-0.5, 0.5)
            scale[:2] = scale[0]
            followed *= 0.5
        elif kind == "rotation":
            shares, periods = np.array([0.04, 0.04, 0.03, 0.14, 0.12, 0.40]), rng.uniform(6, 14, 6)
        elif kind == "insertion":
            shares = np.array([0.04, 0.04, 0.20, 0.03, 0.03, 0.06])
            periods[2], phases[2] = rng.uniform(8, 16), -np.pi / 2
        amplitudes = shares * scale * np.array([distance_mm] * 3 + [1.0] * 3)
        tremor = rng.uniform(0, 1) ** 2 * rng.uniform(0.3, 1, 6) * np.array([0.15] * 3 + [0.002] * 3)
        return cls(
            kind, _six(amplitudes), _six(periods), _six(phases), followed, distance_mm,
            _six(tremor), _six(rng.uniform(3, 9, 6)), _six(rng.uniform(0, 2 * np.pi, 6)),
        )  # fmt: skip

    def pose(self, time_s: float) -> NDArray[np.float64]:
        """Return the world-to-camera transform [4, 4] at a time; identity at time 0."""
        slow = np.array(self.amplitudes) * _wave(time_s / np.array(self.periods_s), np.array(self.phases))
        fast = np.array(self.tremor) * _wave(time_s * np.array(self.tremor_hz), np.array(self.tremor_phases))
        at = slow + fast
        centre, (pan, tilt, roll) = at[:3], at[3:]
        towards = np.array([0, 0, self.looked_at_mm]) - self.followed * np.array([centre[0], centre[1], 0])
        sin, cos = np.sin, np.cos
        turned = np.array([[cos(pan), 0, -sin(pan)], [0, 1, 0], [sin(pan), 0, cos(pan)]])
        tilted = np.array([[1, 0, 0], [0, cos(tilt), -sin(tilt)], [0, sin(tilt), cos(tilt)]])
        return rigid(tilted @ turned @ looking(towards, float(roll)), centre)


def _six(values: NDArray[np.float64]) -> Six:
    x, y, z, pan, tilt, roll = (float(each) for each in values)
    return x, y, z, pan, tilt, roll


def _wave(turns: NDArray[np.float64], phases: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sin(2 * np.pi * turns + phases) - np.sin(phases))


def looking(towards: NDArray[np.float64], roll: float) -> NDArray[np.float64]:
    """Return the rotation of a camera looking in a direction; its rows are the camera's axes."""
    forward = towards / np.linalg.norm(towards)
    right = np.cross([-np.sin(roll), np.cos(roll), 0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def rigid(rotation: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the world-to-camera transform [4, 4] of a camera with a rotation and a centre."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return pose
