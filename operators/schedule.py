"""What was done to a model beside a live stream, call by call: with the same frames and the same calls its pictures come out again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from gsplat_core.scene.frames import Frame


@dataclass(frozen=True)
class ScheduleEvent:
    """One call of the reconstructor."""

    kind: Literal["begin_scene", "observe", "take_depth", "grow", "rehearse"]
    seq: int | None = None
    """The frame that it was called with; None for rehearsal."""
    frame: Frame | None = None
    """That frame with its depth (`take_depth`)."""
    steps: int = 0
    """Steps on the newest frame (`observe`) or on the window (`rehearse`)."""
    train: bool = True
    """False for a frame that was shown and not trained on."""


ScheduleListener = Callable[[ScheduleEvent], None]
