"""A recording played as a source: every frame once, as fast as they are taken."""

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
    """Plays `recording` from its beginning. Nothing is dropped and time plays no part, so a run on it can be repeated.

    The next frames are decoded while the graph works on the present one.
    """

    def __init__(self, recording: Recording, *, ahead: int = 2) -> None:
        super().__init__(ahead=ahead)
        self.recording = recording

    @cached_property
    def description(self) -> SourceDescription:  # type: ignore[override]
        """See `FrameSource`. The digest is computed when this is first asked for."""
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
        """The recording's frames, in order."""
        return iter(self.recording)


def recording_source(address: str, options: SourceOptions) -> FrameSource:
    """A recording on disk, by its path, by the clock where that is asked for. Raises as `open_recording`."""
    if options.realtime:
        return play(address, options)
    return RecordingSource(open_recording(address, scale=options.scale, max_frames=options.max_frames))
