"""How far tissue that a tool pulls comes nearer or goes away, from how it moves across the picture.

Where a tool drags tissue, all of it moves in one direction, less and less with the distance from the tool. In the picture such motion points to, or from,
one point, as does that of still tissue before a scope that goes straight; where that point is says how much of the motion is along the line of sight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOVES_PX = 2.0
"""A point that is off by so much may be pulled."""
FEWEST_POINTS = 30
"""That have to be, to say anything."""
SPREAD_PX = 0.7
"""Errors well above this decide little (Cauchy's scale)."""
ROUNDS = 8
HEAD_ON = 0.05
"""Sine of the angle to the line of sight below which a motion is hardly seen, and not taken for as large as it would have to be."""
LEAST_TOLD = 15.0
"""How many times the errors the second smallest eigenvalue has to be: with less any direction in a plane would do."""


@dataclass(frozen=True)
class Pull:
    """One direction in which tissue moves."""

    direction: Array
    """[3], in the camera's coordinates, of length 1."""
    error_px: float
    """How far points are from moving along it."""

    def along(self, rays: Array, off: Array) -> tuple[Array, Array]:
        """How far points that are seen at `rays` [N, 2], and are `off` [N, 2] from where they were expected, have come along the line of sight, relative
        to their distance, and what of `off` is not explained [N]."""
        across = self.direction[:2] - rays * self.direction[2]
        amount = (off * across).sum(1) / ((across**2).sum(1) + HEAD_ON**2)
        unexplained = np.linalg.norm(off - amount[:, None] * across, axis=1)
        return amount * self.direction[2], unexplained


def pull_of(rays: list[Array], off: list[Array], turns: list[Array], focal_px: float) -> Pull | None:
    """The one direction in which points move that are off, in some pictures shortly after one another; None where there is none to be told.

    rays, off: of each picture [n, 2]. turns: from each camera's coordinates to those in which the direction is wanted [3, 3].
    """
    moved = [np.linalg.norm(each, axis=1) * focal_px > MOVES_PX for each in off]
    if sum(each.sum() for each in moved) < FEWEST_POINTS * len(off):
        return None
    rows, unturned, where = [], [], []
    for ray, each, chosen, turn in zip(rays, off, moved, turns, strict=True):
        r, d = ray[chosen], each[chosen] * focal_px
        # d x (p - r p_z) = 0
        rows.append(np.stack([-d[:, 1], d[:, 0], d[:, 1] * r[:, 0] - d[:, 0] * r[:, 1]], 1) @ turn.T)
        unturned.append(np.repeat(turn[None], len(r), 0))
        where.append(r)
    c, turn, ray = np.concatenate(rows), np.concatenate(unturned), np.concatenate(where)
    # What noise would make of each: p - r p_z is as long as it counts.
    reach = np.stack([np.tile([1.0, 0.0], (len(ray), 1)), np.tile([0.0, 1.0], (len(ray), 1)), -ray], 2) @ turn.swapaxes(
        1, 2
    )
    weight = np.ones(len(c))
    for _ in range(ROUNDS):
        noise = np.einsum("n,nij,nik->jk", weight, reach, reach)
        root = np.linalg.inv(np.linalg.cholesky(noise + 1e-6 * np.trace(noise) * np.eye(3)))
        values, vectors = np.linalg.eigh(root @ ((c * weight[:, None]).T @ c) @ root.T)
        direction = root.T @ vectors[:, 0]
        direction = direction / np.linalg.norm(direction)
        miss = np.abs(c @ direction) / np.maximum(np.linalg.norm(reach @ direction, axis=1), 1e-3)
        weight = 1 / (1 + (miss / SPREAD_PX) ** 2)
    if values[1] < LEAST_TOLD * values[0]:
        return None
    return Pull(direction, float(np.median(miss)))
