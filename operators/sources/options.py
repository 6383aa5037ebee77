"""Options that apply to all sources."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from gsplat_core.errors import InvalidSetting
from operators.settings import check_option

StereoLayout = Literal["side_by_side", "top_bottom"]
MAX_FPS = 1000.0
MAX_SPEED = 1000.0
MAX_WAITING = 64


@dataclass(frozen=True)
class SourceOptions:
    """User options of a source. Raises InvalidSetting for a value out of range."""

    scale: float = 1.0
    """Scale of the frames."""
    max_frames: int | None = None
    """Maximum number of frames."""
    realtime: bool = False
    """Play a recording in real time; live sources do so anyway."""
    loop: bool = False
    """Play a recording in a loop."""
    bounce: bool = False
    """Play every second round of a loop backwards, which avoids a jump between rounds."""
    speed: float = 1.0
    """Playback speed of a recording. `math.inf`: each frame when the previous one is taken, without
    drops.
    """
    fps: float | None = None
    """Frame rate that replaces the recording's own, in frames/s."""
    waiting: int = 2
    """Capacity of the queue for the reader, in frames; if it is full, the oldest is dropped."""
    stereo: StereoLayout | None = None
    """Arrangement of the two eyes in one picture; None for a single eye."""
    process: bool | None = None
    """Read the source in a separate process; None: if sources of its kind can block."""

    def __post_init__(self) -> None:
        if not self.speed > 0:
            raise InvalidSetting(f"speed is {self.speed:g}; it must be positive, 1 is real time")
        if math.isfinite(self.speed) and self.speed > MAX_SPEED:
            raise InvalidSetting(f"speed is {self.speed:g}; it must be at most {MAX_SPEED:g}, or infinite")
        check_option("fps", self.fps)
        if not 1 <= self.waiting <= MAX_WAITING:
            raise InvalidSetting(f"waiting is {self.waiting}; it must be from 1 to {MAX_WAITING} frames")
        if self.stereo is not None and self.stereo not in get_args(StereoLayout):
            raise InvalidSetting(f"stereo is {self.stereo!r}; it must be {' or '.join(get_args(StereoLayout))}")
