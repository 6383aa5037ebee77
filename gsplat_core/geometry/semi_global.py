"""Semi-global matching (Hirschmüller 2008): smooth labels of low cost, here for the distances of a
plane sweep.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SMALL_STEP = 0.02
"""Penalty P1 for a difference of one label between neighbours."""
LARGE_STEP = 0.1
"""Penalty P2 for any larger difference."""


def aggregated(cost: NDArray[np.float32]) -> NDArray[np.float32]:
    """Aggregate matching costs [H, W, D] over paths from four directions."""
    total = np.zeros_like(cost)
    _add_paths(cost, total)
    sideways, across = (
        np.ascontiguousarray(cost.transpose(1, 0, 2)),
        np.zeros((cost.shape[1], cost.shape[0], cost.shape[2]), np.float32),
    )
    _add_paths(sideways, across)
    return total + across.transpose(1, 0, 2)


def _add_paths(cost: NDArray[np.float32], total: NDArray[np.float32]) -> None:
    """Accumulate path costs along the first axis in both directions."""
    for rows in (range(len(cost)), range(len(cost) - 1, -1, -1)):
        before: NDArray[np.float32] | None = None
        for row in rows:
            path = cost[row]
            if before is not None:
                least = before.min(axis=1, keepdims=True)
                best = np.minimum(before, least + np.float32(LARGE_STEP))
                np.minimum(best[:, 1:], before[:, :-1] + np.float32(SMALL_STEP), out=best[:, 1:])
                np.minimum(best[:, :-1], before[:, 1:] + np.float32(SMALL_STEP), out=best[:, :-1])
                path = path + (best - least)
            total[row] += path
            before = path


def best_labels(total: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Select the best labels.

    Args:
        total: aggregated costs float32 [H, W, D].

    Returns:
        Labels [H, W] with sub-label precision by a parabola fit, and their uniqueness [H, W]: the
            relative cost increase of the best label more than two steps away.
    """
    labels = total.shape[2]
    best = total.argmin(axis=2)
    inner = np.clip(best, 1, labels - 2)[..., None]
    below, here, above = (np.take_along_axis(total, inner + step, 2)[..., 0] for step in (-1, 0, 1))
    bend = below - 2 * here + above
    shift = np.where(bend > 1e-6, 0.5 * (below - above) / np.maximum(bend, 1e-6), 0.0)
    shift = np.where(best == inner[..., 0], np.clip(shift, -0.5, 0.5), 0.0)
    least = total.min(axis=2)
    near = np.abs(np.arange(labels) - best[..., None]) <= 2
    second = np.where(near, np.inf, total).min(axis=2)
    unique = (second - least) / np.maximum(least, 1e-6)
    return np.asarray(best + shift, np.float32), np.asarray(unique, np.float32)
