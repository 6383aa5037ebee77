"""Origin of a model's depth, which determines whether its lengths are metric."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gsplat_core.scene.depth_origin import DepthOrigin
from gsplat_core.scene.frames import Frame


class DepthError(NamedTuple):
    """Error of a model's depth at one time."""

    time_s: float
    relative: float
    """Standard error of z, relative to z."""


@dataclass(frozen=True)
class DepthSource:
    """Depth source of the frames that a model was trained on."""

    origin: DepthOrigin
    """Origin of the first frame's depth, from which the scene was initialised."""
    metric: bool
    """True if the unit of all depth is known; the model's lengths are then millimetres."""
    errors: tuple[DepthError, ...] = ()
    """Measured errors of the model's depth, in temporal order; empty if they were not measured."""

    def relative_error(self, time_s: float) -> float:
        """Return the relative standard error of the model's depth at a time, interpolated between the measured ones.

        Without measured errors it is the one assumed for the origin.
        """
        if not self.errors:
            return self.origin.relative_error
        times, values = zip(*self.errors, strict=True)
        return float(np.interp(time_s, times, values))

    @staticmethod
    def of_first(frame: Frame) -> DepthSource | None:
        """Return the source for a scene initialised from `frame`.

        None without depth; the scene then starts on a plane at an arbitrary distance.
        """
        if frame.depth is None or frame.depth_origin is None:
            return None
        return DepthSource(frame.depth_origin, frame.depth_is_metric)

    @staticmethod
    def after(source: DepthSource | None, frame: Frame) -> DepthSource | None:
        """Return the source after another frame: unchanged (also None), but not metric if the frame's depth is not. A
        scene initialised on a plane never becomes metric.
        """
        relative = frame.depth is not None and not frame.depth_is_metric
        return replace(source, metric=False) if source is not None and relative else source
