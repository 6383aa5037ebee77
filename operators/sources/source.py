"""Protocol of frame sources, finite or endless."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Protocol, runtime_checkable

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame


class SourceState(Enum):
    """State of a source."""

    LIVE = "live"
    """Frames arrive as expected."""
    STALLED = "stalled"
    """The source is open, but no frame has arrived for longer than expected."""
    RECONNECTING = "reconnecting"
    """The connection was lost and is being re-established."""
    ENDED = "ended"
    """No more frames: the source ended, failed, or is not open."""


@dataclass(frozen=True)
class SourceDescription:
    """Properties of a source that are known before its first frame."""

    name: str
    width_px: int
    height_px: int
    fps: float
    """Nominal frame rate in frames/s."""
    camera: Camera
    """Camera of the first frame, at the frames' size."""
    fields: frozenset[str] = frozenset()
    """Optional fields that the frames have: `mask`, `depth`, `right_image`, `pose`."""
    frame_count: int | None = None
    """Number of frames; None for an endless stream."""
    digest: str | None = None
    """SHA-256 of the data; None if they cannot be read again."""
    notes: tuple[str, ...] = ()
    """Fallbacks and assumptions, as sentences for the user."""

    @property
    def is_stereo(self) -> bool:
        """True if frames have a picture of the right eye."""
        return "right_image" in self.fields


@runtime_checkable
class FrameSource(Protocol):
    """Sequence of frames from a file, camera or network.

    A source may be endless and may stall. `seq` increases, possibly with gaps, and `pts_ns` never
    decreases. Reading happens in the source's own thread or process. One consumer calls `open`,
    `read` and `close`, from one thread at a time. `state` and `description` are thread-safe.

    A `Recording` (`gsplat_core.io.recordings`) is finite, with random access and a digest; a
    `RecordingSource` plays it.
    """

    @property
    def description(self) -> SourceDescription:
        """Properties known before the first frame."""
        ...

    @property
    def state(self) -> SourceState:
        """Current state."""
        ...

    def open(self) -> None:
        """Start reading. Idempotent."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame as soon as it is available.

        Args:
            timeout_s: maximum waiting time in seconds.

        Returns:
            The frame; None after the timeout or at the end, which `state` distinguishes.

        Raises:
            Exception: the failure of the source, after all earlier frames were returned.
        """
        ...

    def close(self) -> None:
        """Stop reading and release all resources. Idempotent."""
        ...


@runtime_checkable
class ReportingSource(Protocol):
    """`FrameSource` with counts and a state message, such as live sources. Both are thread-safe."""

    def counts(self) -> Mapping[str, int]:
        """Return the numbers of dropped or repaired items since `open`, by reason."""
        ...

    @property
    def state_sentence(self) -> str:
        """State of the source as a sentence without secrets."""
        ...
