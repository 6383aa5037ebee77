"""Log of the calls that changed a live model. Replaying the calls on the same frames reproduces its
pictures.
"""

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
    """Sequence number of the frame argument; None for rehearsal."""
    frame: Frame | None = None
    """The frame with its depth, for `take_depth`."""
    steps: int = 0
    """Optimiser steps on the newest frame (`observe`) or on the window (`rehearse`)."""
    train: bool = True
    """False for a frame that was displayed but not trained on."""


ScheduleListener = Callable[[ScheduleEvent], None]
