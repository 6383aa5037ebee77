"""What every source of frames promises, whether it has an end or not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Protocol, runtime_checkable

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame


class SourceState(Enum):
    """What a source is doing."""

    LIVE = "live"
    """Frames come as they should."""
    STALLED = "stalled"
    """It is open, and no frame has come for longer than it should take."""
    RECONNECTING = "reconnecting"
    """The connection is lost and is being made again."""
    ENDED = "ended"
    """Nothing more will come: it has given its last frame, failed, or is not open."""


@dataclass(frozen=True)
class SourceDescription:
    """What is known about a source before its first frame."""

    name: str
    width_px: int
    height_px: int
    fps: float
    """Nominal frames per second."""
    camera: Camera
    """The camera of the first frame, of the frames' size."""
    fields: frozenset[str] = frozenset()
    """Which of mask, depth, right_image and pose the frames have."""
    frame_count: int | None = None
    """How many frames there are; None for a stream without an end."""
    digest: str | None = None
    """SHA-256 of what is read, where the same can be read again."""
    notes: tuple[str, ...] = ()
    """Fallbacks that were taken, in sentences."""

    @property
    def is_stereo(self) -> bool:
        """Whether frames have a picture of the right eye."""
        return "right_image" in self.fields


@runtime_checkable
class FrameSource(Protocol):
    """Frames one after another, from a file, a camera or a network.

    It may have no end, may stall, and numbers may be missing in `Frame.seq`; `seq` and `pts_ns` never run backwards, and no `seq`
    comes twice. Reading happens in a thread or a process of the source's own. One consumer calls `open`, `read` and `close`, from one
    thread at a time; `state` and `description` may be asked for from any thread.

    A `Recording` (`gsplat_core.io.recordings`) is something else: finite, with random access and a digest. `RecordingSource` plays one.
    """

    @property
    def description(self) -> SourceDescription:
        """What is known before the first frame."""
        ...

    @property
    def state(self) -> SourceState:
        """What the source is doing now."""
        ...

    def open(self) -> None:
        """Begin to read. Without effect when it is open."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, as soon as there is one. None when none has come within `timeout_s`, or none will come: `state` says which.

        Raises what the source failed with, after the frames that came before.
        """
        ...

    def close(self) -> None:
        """Stop reading and release everything. Without effect when it is not open."""
        ...


@runtime_checkable
class ReportingSource(Protocol):
    """A `FrameSource` that says more about itself; sources that follow the clock do. Both may be asked for from any thread."""

    def counts(self) -> Mapping[str, int]:
        """What was dropped or repaired since `open`, by reason."""
        ...

    @property
    def state_sentence(self) -> str:
        """What its state means here, in a sentence without secrets."""
        ...
