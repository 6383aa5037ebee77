"""Motion along the line of sight of tissue pulled by a tool, estimated from its image motion.

Tissue dragged by a tool moves in one direction, with an amplitude that decreases with the distance
from the tool. The image motion of such points converges to a vanishing point, like that of static
tissue in front of a translating scope. The vanishing point gives the share of the motion along the
line of sight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOVES_PX = 2.0
"""Error against the periodic motion in pixels from which a point may be pulled."""
FEWEST_POINTS = 30
"""Average number of such points per picture needed for an estimate."""
SPREAD_PX = 0.7
"""Cauchy scale of errors in pixels."""
ROUNDS = 8
HEAD_ON = 0.05
"""Regularising sine of the angle between motion and line of sight; limits the estimate for motion
seen head-on.
"""
LEAST_TOLD = 15.0
"""Smallest ratio of the second smallest to the smallest generalised eigenvalue; below it the
direction is ambiguous.
"""


@dataclass(frozen=True)
class Pull:
    """Common direction of moving tissue."""

    direction: Array
    """Unit direction in camera coordinates, [3]."""
    error_px: float
    """Median deviation of the points from this direction in pixels."""

    def along(self, rays: Array, off: Array) -> tuple[Array, Array]:
        """Return the relative motion along the line of sight and the unexplained error.

        Args:
            rays: observed rays [N, 2].
            off: ray errors against the expected positions [N, 2].

        Returns:
            Motion away from the camera relative to the distance [N], and the length of the part of
                `off` that is not explained [N].
        """
        across = self.direction[:2] - rays * self.direction[2]
        amount = (off * across).sum(1) / ((across**2).sum(1) + HEAD_ON**2)
        unexplained = np.linalg.norm(off - amount[:, None] * across, axis=1)
        return amount * self.direction[2], unexplained


def pull_of(rays: list[Array], off: list[Array], turns: list[Array], focal_px: float) -> Pull | None:
    """Estimate the common direction of deviating points in a few consecutive pictures.

    Args:
        rays: observed rays of each picture [n, 2].
        off: ray errors of each picture [n, 2].
        turns: rotation [3, 3] from each picture's camera to the camera of the result.
        focal_px: focal length in pixels.

    Returns:
        The direction, or None if too few points deviate or the direction is ambiguous.
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
    # Derivative of each constraint by image noise.
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
