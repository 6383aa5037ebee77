"""Where a model's depth comes from, and with that whether its lengths have a unit."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsplat_core.scene.frames import DepthOrigin, Frame


@dataclass(frozen=True)
class DepthSource:
    """Of the frames that a model was trained on."""

    origin: DepthOrigin
    """Of the first frame's depth, on which the scene started."""
    metric: bool
    """Whether the unit of all of it is known: then the model's lengths are millimetres."""

    @staticmethod
    def of_first(frame: Frame) -> DepthSource | None:
        """Of a scene that starts with this frame; None where it has no depth: the scene starts on a plane, at a distance that means nothing."""
        if frame.depth is None:
            return None
        return DepthSource(frame.depth_origin or DepthOrigin.MEASURED, frame.depth_is_metric)

    @staticmethod
    def after(source: DepthSource | None, frame: Frame) -> DepthSource | None:
        """`source` after another frame: depth without a unit takes the unit from the whole. A scene that started on a plane never gets one."""
        relative = frame.depth is not None and not frame.depth_is_metric
        return replace(source, metric=False) if source is not None and relative else source
