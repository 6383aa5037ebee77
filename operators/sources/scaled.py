"""Source that resizes the frames of another source, for a size chosen after opening."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from gsplat_core.io.recordings.frame_files import resized_frame
from gsplat_core.scene.frames import Frame
from operators.sources.source import FrameSource, ReportingSource, SourceDescription, SourceState


def scaled_description(about: SourceDescription, scale: float) -> SourceDescription:
    """Return the description of a source whose frames are resized by `scale`."""
    camera = about.camera.scaled(scale)
    return replace(about, width_px=camera.width_px, height_px=camera.height_px, camera=camera)


class ScaledSource:
    """`FrameSource` that resizes the frames of another source."""

    def __init__(self, source: FrameSource, scale: float) -> None:
        """Wrap a source.

        Args:
            source: opened and closed together with this one.
            scale: factor on width and height.
        """
        self._source = source
        self.description = scaled_description(source.description, scale)

    @property
    def state(self) -> SourceState:
        """See `FrameSource`."""
        return self._source.state

    @property
    def state_sentence(self) -> str:
        """See `ReportingSource`."""
        return self._source.state_sentence if isinstance(self._source, ReportingSource) else ""

    def counts(self) -> Mapping[str, int]:
        """See `ReportingSource`."""
        return self._source.counts() if isinstance(self._source, ReportingSource) else {}

    def open(self) -> None:
        """See `FrameSource`."""
        self._source.open()

    def read(self, timeout_s: float) -> Frame | None:
        """Read a frame and resize it. A frame of another size keeps the factor instead of the
        stream's size.
        """
        frame = self._source.read(timeout_s)
        if frame is None:
            return None
        own, read = self.description, self._source.description
        if (frame.width_px, frame.height_px) == (read.width_px, read.height_px):
            return resized_frame(frame, own.width_px, own.height_px)
        scale = own.width_px / read.width_px
        sides = (max(1, round(side * scale)) for side in (frame.width_px, frame.height_px))
        return resized_frame(frame, *sides)

    def close(self) -> None:
        """See `FrameSource`."""
        self._source.close()
