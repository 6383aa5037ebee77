"""What a user may ask of any source."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from gsplat_core.errors import InvalidSetting

StereoLayout = Literal["side_by_side", "top_bottom"]
MAX_FPS = 1000.0
MAX_SPEED = 1000.0
MAX_WAITING = 64


@dataclass(frozen=True)
class SourceOptions:
    """What a user may ask of any source. Raises InvalidSetting for a value that is out of its range."""

    scale: float = 1.0
    """Resize the frames by this factor."""
    max_frames: int | None = None
    """End after so many frames."""
    realtime: bool = False
    """Play a recording by the clock; other sources follow it anyway."""
    loop: bool = False
    """Play a recording over and over."""
    bounce: bool = False
    """Play each second round of a looped recording backwards, so that nothing jumps where one round meets the next."""
    speed: float = 1.0
    """How fast a recording's time passes; `math.inf`: each frame as soon as the one before it is taken, and none is dropped."""
    fps: float | None = None
    """Frames per second in place of those that the recording states."""
    waiting: int = 2
    """How many frames wait for whoever reads them; when another one comes the oldest is dropped."""
    stereo: StereoLayout | None = None
    """How the two eyes lie in one picture."""
    process: bool | None = None
    """Whether the source reads in a process of its own; None: where its kind can block."""

    def __post_init__(self) -> None:
        if not self.speed > 0:
            raise InvalidSetting(f"speed is {self.speed:g}; it must be positive, 1 is real time")
        if math.isfinite(self.speed) and self.speed > MAX_SPEED:
            raise InvalidSetting(f"speed is {self.speed:g}; it must be at most {MAX_SPEED:g}, or infinite")
        if self.fps is not None and not 0 < self.fps <= MAX_FPS:
            raise InvalidSetting(f"fps is {self.fps:g}; it must be above 0 and at most {MAX_FPS:g}")
        if not 1 <= self.waiting <= MAX_WAITING:
            raise InvalidSetting(f"waiting is {self.waiting}; it must be from 1 to {MAX_WAITING} frames")
        if self.stereo is not None and self.stereo not in get_args(StereoLayout):
            raise InvalidSetting(f"stereo is {self.stereo!r}; it must be {' or '.join(get_args(StereoLayout))}")
