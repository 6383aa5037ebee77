"""The nearest neighbours of Gaussians."""

from __future__ import annotations

import cv2
import numpy as np
from torch import Tensor

from gsplat_core.geometry.closest import EXACT_KD_TREE
from gsplat_core.transfers import HostCopy, tensor_of

NEIGHBOURS = 8
"""Of each point; fewer where there are fewer points."""


def nearest_others(points: Tensor) -> Tensor:
    """The rows of the points nearest to each of `points` [N, 3], int64 [N, K], itself not among them. Waits for the device.

    Where more than K lie at one place, any of these. A point that is not finite has itself alone, and is nobody's neighbour.
    """
    host = HostCopy(points.detach().float()).numpy()
    finite = np.flatnonzero(np.isfinite(host).all(axis=1))
    count = min(NEIGHBOURS, max(len(finite) - 1, 0))
    others = np.repeat(np.arange(len(host))[:, None], count, axis=1)
    if count:
        there = np.ascontiguousarray(host[finite] - host[finite].mean(axis=0))
        tree = cv2.flann_Index(there, {"algorithm": EXACT_KD_TREE, "leaf_max_size": 10})  # type: ignore[attr-defined]
        found, _ = tree.knnSearch(there, count + 1, params={"checks": -1, "eps": 0.0, "sorted": True})
        # Itself is the first, but where others lie at the same place: then the last one is left out.
        itself = found == np.arange(len(there))[:, None]
        itself[~itself.any(axis=1), -1] = True
        others[finite] = finite[found[~itself].reshape(len(there), count)]
    return tensor_of(np.ascontiguousarray(others.astype(np.int64)), points.device)
