"""The median and its like, without what numpy's own does besides: it is taken many times a frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def median_of(values: NDArray[np.floating], share: float = 0.5) -> float:
    """The value that this share of them, at least one and in one dimension, lies below; between two the upper one."""
    at = int(share * len(values))
    return float(np.partition(values, at)[at])
