"""Source that reads a recording once, as fast as frames are consumed."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

from gsplat_core.io.recordings import Recording, open_recording
from gsplat_core.scene.frames import Frame
from operators.sources.options import SourceOptions
from operators.sources.realtime import play
from operators.sources.source import FrameSource, SourceDescription
from operators.sources.threaded import ThreadedSource


class RecordingSource(ThreadedSource):
    """Reads `recording` from its beginning, without drops or timing, so that a run is reproducible.

    The next frames are decoded in advance.
    """

    def __init__(self, recording: Recording, *, ahead: int = 2) -> None:
        super().__init__(ahead=ahead)
        self.recording = recording

    @cached_property
    def description(self) -> SourceDescription:  # type: ignore[override]
        """Description of the source. The digest is computed on first access."""
        recording = self.recording
        return SourceDescription(
            name=recording.name,
            width_px=recording.width_px,
            height_px=recording.height_px,
            fps=recording.fps,
            camera=recording.camera,
            fields=recording.fields,
            frame_count=recording.frame_count,
            digest=recording.digest,
            notes=recording.notes,
        )

    def frames(self) -> Iterator[Frame]:
        """Return an iterator over the recording's frames, in order."""
        return iter(self.recording)


def recording_source(address: str, options: SourceOptions) -> FrameSource:
    """Open a recording by its path, in real time if requested. Raises the errors of
    `open_recording`.
    """
    if options.realtime:
        return play(address, options)
    return RecordingSource(open_recording(address, scale=options.scale, max_frames=options.max_frames))
