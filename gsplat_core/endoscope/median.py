"""Fast quantiles of one-dimensional arrays, used many times per frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def median_of(values: NDArray[np.floating], share: float = 0.5) -> float:
    """Return the value at a quantile of at least one value; between two values the upper one."""
    at = int(share * len(values))
    return float(np.partition(values, at)[at])
