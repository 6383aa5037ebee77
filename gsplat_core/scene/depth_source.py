"""Origin of a model's depth, which determines whether its lengths are metric."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsplat_core.scene.depth_origin import DepthOrigin
from gsplat_core.scene.frames import Frame


@dataclass(frozen=True)
class DepthSource:
    """Depth source of the frames that a model was trained on."""

    origin: DepthOrigin
    """Origin of the first frame's depth, from which the scene was initialised."""
    metric: bool
    """True if the unit of all depth is known; the model's lengths are then millimetres."""

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
        """Return the depth source after another frame. Depth without a metric scale in any frame makes the model
        non-metric.

        A scene initialised on a plane never becomes metric.
        """
        relative = frame.depth is not None and not frame.depth_is_metric
        return replace(source, metric=False) if source is not None and relative else source
