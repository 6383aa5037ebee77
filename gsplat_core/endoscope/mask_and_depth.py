"""What came with a picture: a tool mask that cannot be one, depth that is none."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.endoscope.setting_ranges import check_settings
from gsplat_core.value_ranges import IntegerIn, NumberIn

STEP_PX = 4
"""At most every fourth row and column is looked at ..."""
SAMPLES = 128
"""... of larger pictures about so many of the shorter side."""


@dataclass(frozen=True)
class MaskAndDepthSettings:
    """When mask or depth are wrong. Raises InvalidSetting out of range."""

    least_tissue: float = 0.02
    """A frame with a smaller share of tissue has nothing to learn from."""
    lost_tool_share: float = 0.05
    """A tool of at least this share that is gone altogether in the next frame is a mask that was lost ..."""
    lost_frames: int = 5
    """... for at most so many frames; then the tool has left."""
    farthest_mm: float = 2000.0
    """Depth beyond this is none: no endoscope looks further."""
    wrong_depth_share: float = 0.2
    """With a larger share of values that are no depth (not finite, negative, too far) all of a frame's depth is left out."""
    usual_depth_ratio: float = 4.0
    """So is it when its median is this many times the median of the frames before, or less than its inverse ..."""
    unusual_frames: int = 10
    """... for at most so many frames; then that is the new distance."""

    def __post_init__(self) -> None:
        share, count = NumberIn(0.0, 1.0), IntegerIn(1, 10_000)
        check_settings(
            self,
            least_tissue=share,
            lost_tool_share=share,
            lost_frames=count,
            farthest_mm=NumberIn(1.0, 1e9),
            wrong_depth_share=share,
            usual_depth_ratio=NumberIn(1.01, 1e6),
            unusual_frames=count,
        )


class MaskCheck:
    """Looks at each frame's tool mask beside the one before."""

    def __init__(self, settings: MaskAndDepthSettings | None = None) -> None:
        self.settings = settings or MaskAndDepthSettings()
        self._tool_share = 0.0
        self._lost = 0

    def fault(self, mask: NDArray[np.generic]) -> str | None:
        """ "no tissue" or "tool mask lost" of the mask [H, W], 1 = tissue; None where it can be one."""
        some = _some(mask)
        tissue = np.count_nonzero(some) / some.size
        if tissue < self.settings.least_tissue:
            return "no tissue"
        if (
            tissue == 1.0
            and self._tool_share >= self.settings.lost_tool_share
            and self._lost < self.settings.lost_frames
        ):
            self._lost += 1
            return "tool mask lost"
        self._tool_share, self._lost = 1 - tissue, 0
        return None


@dataclass(frozen=True)
class CheckedDepth:
    """A frame's depth, without what is none."""

    depth: NDArray[np.float32] | None
    """float32 [H, W] in millimetres, 0 = unknown, the very array that was given where nothing is wrong with it; None: left out."""
    finding: str | None = None
    """"depth repaired", "depth not usable" or "depth at another scale"; None: nothing was found."""


class DepthCheck:
    """Looks at each frame's depth beside those before."""

    def __init__(self, settings: MaskAndDepthSettings | None = None) -> None:
        self.settings = settings or MaskAndDepthSettings()
        self._medians: deque[float] = deque(maxlen=15)
        self._unusual = 0

    def checked(self, depth: NDArray[np.floating]) -> CheckedDepth:
        """The depth [H, W] of a frame, in millimetres, 0 = unknown."""
        settings = self.settings
        sampled = _some(depth)
        possible = self._possible(sampled)
        if 1 - np.count_nonzero(possible) / possible.size > settings.wrong_depth_share:
            return CheckedDepth(None, "depth not usable")
        known = sampled[possible & (sampled > 0)]
        if len(known) and self._at_another_scale(float(np.median(known))):
            return CheckedDepth(None, "depth at another scale")
        # Both are NaN where a value is.
        if depth.min() >= 0 and depth.max() <= settings.farthest_mm:
            return CheckedDepth(depth)
        return CheckedDepth(np.where(self._possible(depth), depth, 0).astype(np.float32), "depth repaired")

    def _possible(self, depth: NDArray[np.floating]) -> NDArray[np.bool_]:
        # Comparisons with NaN are false.
        return (depth >= 0) & (depth <= self.settings.farthest_mm)

    def _at_another_scale(self, median_mm: float) -> bool:
        usual_mm = float(np.median(self._medians)) if self._medians else median_mm
        ratio = max(median_mm / usual_mm, usual_mm / median_mm)
        if ratio >= self.settings.usual_depth_ratio:
            self._unusual += 1
            if self._unusual <= self.settings.unusual_frames:
                return True
            self._medians.clear()
        self._unusual = 0
        self._medians.append(median_mm)
        return False


def _some(plane: NDArray[Any]) -> NDArray[Any]:
    """Some of a plane's rows and columns."""
    step = max(STEP_PX, min(plane.shape) // SAMPLES)
    return np.ascontiguousarray(plane[::step, ::step])
