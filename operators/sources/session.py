"""Source that reads the prepared frames of a recorded session, with the analysis results of that
time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from gsplat_core.io.recordings import Recording
from gsplat_core.io.sessions import SessionReader
from gsplat_core.scene.frames import Frame
from operators.sources.recording import RecordingSource
from operators.sources.threaded import ThreadedSource


class SessionSource(ThreadedSource):
    """Reads a session's prepared frames once, in order, as fast as they are consumed."""

    def __init__(self, reader: SessionReader, recording: Recording, *, max_frames: int | None = None) -> None:
        """Describe the source.

        Args:
            reader: reader of the session.
            recording: the same session as a recording, for the description.
            max_frames: maximum number of frames; None for all.
        """
        super().__init__()
        self._reader = reader
        count = reader.prepared_count
        self._most = count if max_frames is None else min(count, max_frames)
        self.description = replace(RecordingSource(recording).description, fields=frozenset(), frame_count=self._most)

    def frames(self) -> Iterator[Frame]:
        """See `ThreadedSource`."""
        for _, frame in zip(range(self._most), self._reader.prepared(), strict=False):
            yield frame
