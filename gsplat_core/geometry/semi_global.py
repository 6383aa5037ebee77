"""Semi-global matching (Hirschmüller 2008): labels (distances) of low cost that change little from pixel to pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SMALL_STEP = 0.02
"""Penalty for a difference of one label between neighbours (P1)."""
LARGE_STEP = 0.1
"""Penalty for any larger one (P2)."""


def aggregated(cost: NDArray[np.float32]) -> NDArray[np.float32]:
    """Costs [H, W, D] summed over the cheapest paths from the four sides to each pixel."""
    total = np.zeros_like(cost)
    _add_paths(cost, total)
    sideways, across = (
        np.ascontiguousarray(cost.transpose(1, 0, 2)),
        np.zeros((cost.shape[1], cost.shape[0], cost.shape[2]), np.float32),
    )
    _add_paths(sideways, across)
    return total + across.transpose(1, 0, 2)


def _add_paths(cost: NDArray[np.float32], total: NDArray[np.float32]) -> None:
    """Along the first axis, in both directions."""
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
    """The cheapest label of each pixel [H, W], refined between whole ones by a parabola, and its uniqueness [H, W]: by how much the next best label
    further than two away costs more, as a share of its own cost."""
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
