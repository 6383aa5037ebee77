"""Plausibility checks of tool masks and depth maps that accompany pictures."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

STEP_PX = 4
"""Smallest subsampling step of rows and columns in pixels."""
SAMPLES = 128
"""Approximate number of samples along the shorter side of larger pictures."""


LEAST_TISSUE = 0.02
"""Share of tissue below which a frame is not trained on."""
LOST_TOOL_SHARE = 0.05
"""Share of tool pixels in the previous mask from which a mask without any tool counts as lost."""
LOST_FRAMES, LOST_S = 5, 0.19
"""Largest number of consecutive frames with a lost mask, and their duration in seconds. After that the tool counts as
withdrawn.
"""
FARTHEST_MM = 2000.0
"""Largest plausible depth for an endoscope, in millimetres."""
WRONG_DEPTH_SHARE = 0.2
"""Share of invalid values (not finite, negative or too far) from which a frame's depth is discarded."""
USUAL_DEPTH_RATIO = 4.0
"""Ratio of the median depth to that of earlier frames, in either direction, from which a frame's depth is discarded."""
UNUSUAL_FRAMES = 10
"""Largest number of consecutive discarded frames. After that the new distance is accepted."""


class MaskCheck:
    """Consistency check of consecutive tool masks."""

    def __init__(self) -> None:
        self._tool_share = 0.0
        self._lost = 0
        self._seen_ns = 0
        """Time of the newest mask that was not lost."""

    def fault(self, mask: NDArray[np.generic], pts_ns: int) -> str | None:
        """Return "no tissue" or "tool mask lost" for a faulty mask [H, W] (1 = tissue) at `pts_ns`, else None."""
        some = _some(mask)
        tissue = np.count_nonzero(some) / some.size
        if tissue < LEAST_TISSUE:
            return "no tissue"
        lost_s = (pts_ns - self._seen_ns) * 1e-9
        gone = tissue == 1.0 and self._tool_share >= LOST_TOOL_SHARE
        if gone and self._lost < LOST_FRAMES and 0 <= lost_s <= LOST_S:
            self._lost += 1
            return "tool mask lost"
        self._tool_share, self._seen_ns, self._lost = 1 - tissue, pts_ns, 0
        return None


@dataclass(frozen=True)
class CheckedDepth:
    """Depth of a frame without invalid values."""

    depth: NDArray[np.float32] | None
    """float32 [H, W] in millimetres, 0 = unknown; the given array if it is valid. None if discarded."""
    finding: str | None = None
    """Finding "depth repaired", "depth not usable" or "depth at another scale"; None for valid depth."""


class DepthCheck:
    """Consistency check of consecutive depth maps."""

    def __init__(self) -> None:
        self._medians: deque[float] = deque(maxlen=15)
        self._unusual = 0

    def checked(self, depth: NDArray[np.floating]) -> CheckedDepth:
        """Check a depth map [H, W] in millimetres, 0 = unknown."""
        sampled = _some(depth)
        possible = self._possible(sampled)
        if 1 - np.count_nonzero(possible) / possible.size > WRONG_DEPTH_SHARE:
            return CheckedDepth(None, "depth not usable")
        known = sampled[possible & (sampled > 0)]
        if len(known) and self._at_another_scale(float(np.median(known))):
            return CheckedDepth(None, "depth at another scale")
        # Minimum and maximum are NaN if any value is NaN.
        if depth.min() >= 0 and depth.max() <= FARTHEST_MM:
            return CheckedDepth(depth)
        return CheckedDepth(np.where(self._possible(depth), depth, 0).astype(np.float32), "depth repaired")

    def _possible(self, depth: NDArray[np.floating]) -> NDArray[np.bool_]:
        # Comparisons with NaN are false.
        return (depth >= 0) & (depth <= FARTHEST_MM)

    def _at_another_scale(self, median_mm: float) -> bool:
        usual_mm = float(np.median(self._medians)) if self._medians else median_mm
        ratio = max(median_mm / usual_mm, usual_mm / median_mm)
        if ratio >= USUAL_DEPTH_RATIO:
            self._unusual += 1
            if self._unusual <= UNUSUAL_FRAMES:
                return True
            self._medians.clear()
        self._unusual = 0
        self._medians.append(median_mm)
        return False


def _some(plane: NDArray[Any]) -> NDArray[Any]:
    """Return every n-th row and column of a plane, about `SAMPLES` along its shorter side."""
    step = max(STEP_PX, min(plane.shape) // SAMPLES)
    return np.ascontiguousarray(plane[::step, ::step])
