"""Base class of streams from external senders: default camera, repaired or evenly spaced timestamps, resizing."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.calibration import default_camera
from gsplat_core.io.recordings.frame_files import resized_frame
from gsplat_core.io.recordings.plain_files import MAX_PIXELS
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.sources.live import STALLED_AFTER_S, FrameOrder, LiveSource
from operators.sources.options import SourceOptions
from operators.sources.source import SourceDescription

PULL = 0.05
"""Share of the lag behind the clock that each frame corrects."""
JUMP_S = 1.0
"""Lag in seconds that counts as a pause of the sender and is corrected at once."""


class SteadyClock:
    """Advances the timestamp by one period per frame, plus a correction if it lags behind the
    clock.

    Arrival times jitter, which would disturb a deformation learned over time. Frames that arrive
    faster than the nominal rate, for example from a piped file, keep that rate.
    """

    def __init__(self, fps: float) -> None:
        self._period_ns = 1e9 / fps
        self._first_ns: int | None = None
        self._time_ns = 0.0

    def time_ns(self, arrived_ns: int) -> int:
        """Return the timestamp in nanoseconds of a frame that arrived at `arrived_ns`; 0 for the
        first one.
        """
        if self._first_ns is None:
            self._first_ns = arrived_ns
            return 0
        self._time_ns += self._period_ns
        lag_ns = arrived_ns - self._first_ns - self._time_ns
        if lag_ns > 0:
            self._time_ns += lag_ns if lag_ns > JUMP_S * 1e9 else PULL * lag_ns
        return round(self._time_ns)


DEFAULT_FPS = 30.0
MIN_SIDE_PX = 8


class StreamSource(LiveSource):
    """`LiveSource` for an external sender. A subclass calls `describe` and implements
    `pictures()`.
    """

    def __init__(self, options: SourceOptions, *, stalled_after_s: float = STALLED_AFTER_S) -> None:
        """Set the options.

        Args:
            options: `scale`, `max_frames` and `waiting` apply. An infinite `speed` makes the sender
                wait instead of dropping frames.
            stalled_after_s: time without a frame until the state is `STALLED`, in seconds.
        """
        super().__init__(
            waiting=options.waiting,
            stalled_after_s=stalled_after_s,
            drops=math.isfinite(options.speed),
            order=FrameOrder(),
        )
        self.options = options

    def describe(
        self,
        name: str,
        size: tuple[int, int],
        fps: float | None,
        *,
        camera: Camera | None = None,
        fields: frozenset[str] = frozenset(),
    ) -> None:
        """Set `description`.

        Args:
            name: name of the source for the user.
            size: width and height of the received frames, in pixels.
            fps: frame rate; None if unknown.
            camera: calibration; None if unknown.
            fields: optional fields that the frames have.

        Raises:
            InvalidSetting: the frames are too large, or too small after scaling.
        """
        check_size(name, *size)
        notes = []
        if fps is None:
            notes.append(f"{name}: the frame rate is not stated. {DEFAULT_FPS:g} frames/s are assumed.")
        if camera is None:
            camera = default_camera(*size)
            notes.append(
                f"{name}: there is no calibration; a pinhole with f = {camera.K[0, 0]:.1f} px and no camera motion is assumed. "
                "Lengths have no scale."
            )
        camera = camera.scaled(self.options.scale)
        check_size(name, camera.width_px, camera.height_px, least=MIN_SIDE_PX if self.options.scale != 1 else 1)
        self.description = SourceDescription(
            name=name,
            width_px=camera.width_px,
            height_px=camera.height_px,
            fps=fps or DEFAULT_FPS,
            camera=camera,
            fields=fields,
            frame_count=self.options.max_frames,
            notes=tuple(notes),
        )

    def pictures(self) -> Iterator[Frame]:
        """Yield frames on arrival, with the sender's numbers and timestamps. Runs in the reader's
        thread.
        """
        raise NotImplementedError(f"{type(self).__name__} has no pictures method")

    def frames(self) -> Iterator[Frame]:
        """See `LiveSource`."""
        for given, frame in enumerate(self.pictures(), start=1):
            if frame.status is FrameStatus.DAMAGED:
                # As in recordings, no pixel of a damaged picture counts as tissue.
                frame = replace(frame, mask=np.zeros(frame.image.shape[:2], np.uint8))
            yield resized(frame, self.options.scale)
            if given == self.options.max_frames:
                return


def check_size(name: str, width_px: int, height_px: int, least: int = 1) -> None:
    """Check the size of frames.

    Args:
        name: name of the source, for the error message.
        width_px: width in pixels.
        height_px: height in pixels.
        least: minimum side in pixels.

    Raises:
        InvalidSetting: a side is too short, or there are more than `MAX_PIXELS` pixels.
    """
    if min(width_px, height_px) < least or width_px * height_px > MAX_PIXELS:
        raise InvalidSetting(
            f"{name}: frames of {width_px}x{height_px} px cannot be used; both sides must be at least {least} px, and at most"
            f" {MAX_PIXELS} pixels are possible"
        )


def resized(frame: Frame, scale: float) -> Frame:
    """Return the frame with width and height multiplied by `scale`.

    Images are resampled by area averaging, mask and depth by nearest neighbour.
    """
    if scale == 1:
        return frame
    size = max(1, round(frame.width_px * scale)), max(1, round(frame.height_px * scale))
    return resized_frame(frame, *size)
