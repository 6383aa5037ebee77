"""The frames of a recorded session as training was given them: with all that was found out about them at the time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from gsplat_core.io.recordings import Recording
from gsplat_core.io.sessions import SessionReader
from gsplat_core.scene.frames import Frame
from operators.sources.recording import RecordingSource
from operators.sources.threaded import ThreadedSource


class SessionSource(ThreadedSource):
    """Plays a session's frames once, in order, as fast as they are taken."""

    def __init__(self, reader: SessionReader, recording: Recording, *, max_frames: int | None = None) -> None:
        """recording: the same session as a recording, for what is known about it."""
        super().__init__()
        self._reader = reader
        count = reader.prepared_count
        self._most = count if max_frames is None else min(count, max_frames)
        self.description = replace(RecordingSource(recording).description, fields=frozenset(), frame_count=self._most)

    def frames(self) -> Iterator[Frame]:
        """See `ThreadedSource`."""
        for _, frame in zip(range(self._most), self._reader.prepared(), strict=False):
            yield frame
