"""Sources that read recordings: in real time and optionally in a loop, as fast as frames are consumed, or the prepared frames of a
recorded session; and an endless source of the synthetic scene.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from functools import cached_property

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import Recording, open_recording
from gsplat_core.io.recordings.contents import read_ahead
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, kept_recording
from gsplat_core.io.sessions import SessionReader
from gsplat_core.scene.frames import Frame
from operators.errors import SourceLost
from operators.sources.address import RealtimeAddress, SourceOptions, SyntheticAddress
from operators.sources.live import LiveSource
from operators.sources.source import FrameSource, SourceDescription, ThreadedSource

DECODED_AHEAD = 4
"""Number of frames decoded in advance."""
REMEMBERED_BYTES = 512 * 2**20
"""Maximum size of a looped recording that is kept decoded in memory."""
GIVEN_UP_S = 0.5
"""Delay of a frame in seconds after which the playback clock is shifted instead of catching up."""


class RealtimeSource(LiveSource):
    """Plays `recording` by the monotonic clock with its masks, poses and depth.

    Each frame is released at its time, independent of the consumer. In a loop, numbers and
    timestamps continue with one frame interval between rounds. `too_late` counts frames that the
    consumer did not read in time, `decoded_late` frames that were not decoded in time.
    """

    def __init__(self, recording: Recording, options: SourceOptions | None = None) -> None:
        """Create the source for a recording, and describe its frames.

        Args:
            recording: the recording.
            options: `loop`, `bounce`, `speed`, `fps`, `max_frames` over all rounds, and `waiting` apply.
        """
        options = options or SourceOptions()
        super().__init__(waiting=options.waiting, drops=math.isfinite(options.speed))
        self.recording, self.options = recording, options
        fps = options.fps or recording.fps
        self._stretch = recording.fps / fps
        self._period_ns = round(1e9 / fps)
        count = None if options.loop else recording.frame_count
        self.description = SourceDescription(
            name=recording.name,
            width_px=recording.width_px,
            height_px=recording.height_px,
            fps=fps,
            camera=recording.camera,
            fields=recording.fields,
            # A looped recording has an end only with `max_frames`.
            frame_count=options.max_frames if count is None else min(count, options.max_frames or count),
            notes=recording.notes,
        )

    def frames(self) -> Iterator[Frame]:
        """Yield each frame when the playback clock reaches its timestamp."""
        speed = self.options.speed
        start_ns: int | None = None
        with closing(read_ahead(self._numbered(), f"decode {self.description.name}", DECODED_AHEAD)) as decoded:
            for frame in decoded:
                if math.isfinite(speed):
                    # Start the clock with the first picture, so that opening the file does not delay the second one.
                    start_ns = time.monotonic_ns() if start_ns is None else start_ns
                    due_ns = start_ns + round(frame.pts_ns / speed)
                    late_ns = time.monotonic_ns() - due_ns
                    if late_ns < 0 and self.wait(-late_ns * 1e-9):
                        return
                    if late_ns > self._period_ns / speed:
                        self.count("decoded_late")
                    if late_ns > GIVEN_UP_S * 1e9:
                        self.count("clock_restarts")
                        start_ns += late_ns
                yield frame

    def _numbered(self) -> Generator[Frame, None, None]:
        """Yield the frames of all rounds with continuous numbers and timestamps."""
        most = self.description.frame_count or math.inf
        seq, pts_ns = 0, 0
        for frames in self._rounds():
            began_ns = None
            end_ns = pts_ns
            for frame in frames:
                own_ns = round(frame.pts_ns * self._stretch)
                began_ns = own_ns if began_ns is None else began_ns
                at_ns = pts_ns + own_ns - began_ns
                yield replace(frame, seq=seq, pts_ns=at_ns)
                end_ns = at_ns + self._period_ns
                seq += 1
                if seq >= most:
                    return
            pts_ns = end_ns

    def _rounds(self) -> Iterator[Iterator[Frame]]:
        """Yield an iterator of frames per round. From the second round on the frames come from memory, if they fit."""
        if not self.options.loop:
            yield iter(self.recording)
            return
        remembered: list[Frame] = []
        yield self._remembering(remembered)
        if self.options.bounce and not remembered:
            raise SourceLost(
                f"{self.recording.name} is too large to be played backwards: its frames take more than {REMEMBERED_BYTES >> 20} MiB. "
                "Give a smaller scale, or fewer frames."
            )
        backwards = self._backwards(remembered) if self.options.bounce else []
        while True:
            if backwards:
                yield iter(backwards)
            yield iter(remembered or self.recording)

    def _backwards(self, forwards: list[Frame]) -> list[Frame]:
        """Return a backward round: the frames between the first and the last in reverse order, with increasing
        timestamps."""
        last_ns = forwards[-1].pts_ns
        return [replace(frame, pts_ns=last_ns - frame.pts_ns) for frame in reversed(forwards[1:-1])]

    def _remembering(self, remembered: list[Frame]) -> Iterator[Frame]:
        """Yield the frames of the first round, storing them in `remembered` unless they are too large."""
        size = 0
        fits = True
        for frame in self.recording:
            size += sum(
                plane.nbytes for plane in (frame.image, frame.right_image, frame.depth, frame.mask) if plane is not None
            )
            fits = fits and size <= REMEMBERED_BYTES
            if fits:
                remembered.append(frame)
            else:
                remembered.clear()
            yield frame


def realtime_source(rest: str, options: SourceOptions) -> RealtimeSource:
    """Open `realtime:PATH?loop=1&speed=2&fps=60`; `loop=bounce` plays every second round backwards.

    Raises InvalidSetting for invalid options, and the errors of `open_recording`.
    """
    address = RealtimeAddress.parse(rest, options)
    return play(address.place, address.options)


def play(path: str, options: SourceOptions) -> RealtimeSource:
    """Open a recording on disk for playback in real time.

    Raises:
        InvalidSetting: the recording has no frames.
        RecordingError: as `open_recording` raises it.
    """
    recording = open_recording(path, scale=options.scale, max_frames=None if options.loop else options.max_frames)
    if recording.frame_count < 1:
        raise InvalidSetting(f"{recording.name} has no frames")
    return RealtimeSource(recording, options)


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
    """Open a recording by its path, in real time if requested. Raises the errors of `open_recording`."""
    if options.realtime:
        return play(address, options)
    return RecordingSource(open_recording(address, scale=options.scale, max_frames=options.max_frames))


class SessionSource(ThreadedSource):
    """Reads a session's prepared frames once, in order, as fast as they are consumed."""

    def __init__(self, reader: SessionReader, recording: Recording, *, max_frames: int | None = None) -> None:
        """Create the source for a recorded session, and describe its frames.

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
        """Yield the session's frames as they were prepared for training, in order."""
        for _, frame in zip(range(self._most), self._reader.prepared(), strict=False):
            yield frame


log = logging.getLogger(__name__)
DEFAULT_FRAMES = 48
MOST_BYTES = 512 * 2**20
"""Maximum size in bytes of the rendered frames, which are played forwards and backwards."""


def synthetic_source(rest: str, options: SourceOptions) -> RealtimeSource:
    """Open `synthetic:?width=640&height=512&fps=30&seed=0&frames=48&moving=1&eyes=1`.

    Ray casting is slower than real time, so `frames` frames are rendered first and then played forwards and backwards.
    They are cached for later runs. Raises InvalidSetting for options out of range.
    """
    address = SyntheticAddress.parse(rest, options)
    width, height = (max(32, round(side * options.scale)) for side in (address.width_px, address.height_px))
    per_frame = width * height * (8 if address.eyes == 1 else 11)
    fits = max(1, MOST_BYTES // per_frame)
    settings = RenderSettings(
        frames=min(address.frames or DEFAULT_FRAMES, fits),
        width_px=width,
        height_px=height,
        fps=address.fps,
        seed=address.seed,
        camera="moving" if address.moving else "fixed",
        stereo=address.eyes == 2,
    )
    recording = kept_recording(settings, progress=_say)
    return RealtimeSource(recording, replace(options, loop=True, bounce=recording.frame_count > 2, fps=None))


def _say(done: int, frames: int) -> None:
    if done == 1 or done % 10 == 0 or done == frames:
        log.info("synthetic: rendered %d of %d frames", done, frames)
