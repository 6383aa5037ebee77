"""Nearest neighbours within a set of points."""

from __future__ import annotations

import cv2
import numpy as np
from torch import Tensor

from gsplat_core.geometry.registration import EXACT_KD_TREE
from gsplat_core.transfers import HostCopy, tensor_of

NEIGHBOURS = 8
"""Default number of neighbours per point; fewer if there are fewer points."""


def nearest_others(points: Tensor, most: int = NEIGHBOURS) -> Tensor:
    """Return the indices of the nearest other points of `points` [N, 3], int64 [N, K], K at most `most`.

    Synchronises with the device. Ties are broken arbitrarily. A non-finite point has only itself as neighbour and is no
    neighbour of others.
    """
    host = HostCopy(points.detach().float()).numpy()
    finite = np.flatnonzero(np.isfinite(host).all(axis=1))
    count = min(most, max(len(finite) - 1, 0))
    others = np.repeat(np.arange(len(host))[:, None], count, axis=1)
    if count:
        there = np.ascontiguousarray(host[finite] - host[finite].mean(axis=0))
        tree = cv2.flann_Index(there, {"algorithm": EXACT_KD_TREE, "leaf_max_size": 10})  # type: ignore[attr-defined]
        found, _ = tree.knnSearch(there, count + 1, params={"checks": -1, "eps": 0.0, "sorted": True})
        # A point is its own first result, unless other points coincide with it. In that case drop the
        # last result instead.
        itself = found == np.arange(len(there))[:, None]
        itself[~itself.any(axis=1), -1] = True
        others[finite] = finite[found[~itself].reshape(len(there), count)]
    return tensor_of(np.ascontiguousarray(others.astype(np.int64)), points.device)
