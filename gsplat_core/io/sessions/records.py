"""Records of a session's recording: the lines of its log, the schedule of training calls, and `session.json`.

A log consists of JSON lines. Each line is one object with its kind under `event`. Each line is written by one system
call, so only the last line can be truncated. The schedule lists the training calls of a live session, so that replay can
repeat them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError

from gsplat_core.errors import InvalidInput, RecordingInvalid
from gsplat_core.io.files import PartialFile
from gsplat_core.io.frame_codec import (
    CameraRecord,
    Count,
    FrameFields,
    Nanoseconds,
    NotNegative,
    Origin,
    Pose,
    Record,
    Side,
    Text,
    camera_of,
)
from gsplat_core.io.recordings.plain_files import UnreadableFile, open_plain, printable

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
TrackName = Literal["image", "right_image", "mask", "loss_mask", "depth", "depth_confidence", "shown"]
REMOVED_TRACK = "rehearsal_mask"
"""Track that earlier versions recorded. It is ignored."""


def _without_removed(names: Any) -> Any:
    """Return the tracks of a log line, an object or a list, without `REMOVED_TRACK`."""
    if isinstance(names, dict):
        return {name: time for name, time in names.items() if name != REMOVED_TRACK}
    return tuple(name for name in names if name != REMOVED_TRACK) if isinstance(names, list | tuple) else names


Tracks = Annotated[dict[TrackName, Count], BeforeValidator(_without_removed)]
"""Timestamps of a log line's pictures, in milliseconds within the track's file, by track."""


class SegmentBegins(Record):
    """First line of each log."""

    event: Literal["segment"] = "segment"
    number: Count
    why: Text
    """Reason for starting a new segment: "begin" of the recording, or the limit of the previous one, "bytes" or
    "seconds".
    """
    utc: Text
    """Wall-clock date and time in ISO 8601."""
    monotonic_ns: Nanoseconds
    """Start of the segment in nanoseconds on the monotonic clock of `arrived_ns` and `shown_ns`."""


class _PictureLine(Record):
    # FrameFields follow in the subclasses, so that `event` is the first key of a line.
    event: str
    seq: Count
    pts_ns: Nanoseconds
    width_px: Side
    height_px: Side
    tracks: Tracks
    pose: Pose | None = None
    """World-to-camera pose [4, 4] of the frame in row-major order."""


class FrameLine(FrameFields, _PictureLine):
    """Log line of a frame as received, after the out-of-body gate and the concurrent image checks."""

    event: Literal["frame"] = "frame"


class PreparedLine(FrameFields, _PictureLine):
    """Log line of a frame as passed to training.

    A plane without a track here, but listed in `same`, equals that of the received frame.
    """

    event: Literal["prepared"] = "prepared"
    same: Annotated[tuple[TrackName, ...], BeforeValidator(_without_removed)]


class ShownLine(Record):
    """Log line of a displayed picture."""

    event: Literal["shown"] = "shown"
    seq: Count
    """Sequence number of the frame whose content is shown."""
    width_px: Side
    height_px: Side
    model_version: Count
    sha256: Digest | None = None
    """SHA-256 of the rendered RGB bytes before the status overlay.

    None if the picture was already on the screen and only its status or age changed.
    """
    shown_ns: Nanoseconds | None = None
    age_ns: Nanoseconds | None = None
    """Time from the arrival of the newest frame in the picture until the picture's display, in nanoseconds."""
    state: Text | None = None
    tracks: Tracks
    """Timestamp of the picture as displayed, in the track `shown`."""


class LostLine(Record):
    """Log line in place of a record that was not written.

    Reasons are writing that was too slow, or a record that does not fit into a line.
    """

    event: Literal["lost"] = "lost"
    seq: Count
    what: Literal["frame", "prepared", "shown", "depth"]
    why: Text


class DeletedLine(Record):
    """Log line for an older segment that was deleted to keep the recording within its limits."""

    event: Literal["deleted"] = "deleted"
    segment: Count
    bytes: Count


class NoteLine(Record):
    """Log line with a human-readable remark."""

    event: Literal["note"] = "note"
    text: Text


class SegmentEnds(Record):
    """Last line of a complete log."""

    event: Literal["end"] = "end"
    why: Text
    """Reason for ending the segment.

    After "bytes" and "seconds" another segment follows. Any other reason ended the recording.
    """
    frames: Count
    """Number of `frame` lines in the segment."""


Steps = Annotated[int, Field(ge=0, le=10_000_000)]


class ReconstructorMade(Record):
    """Schedule line of the creation of a reconstructor: at the start, or after a restart of an operator."""

    event: Literal["reconstructor"] = "reconstructor"
    device: Text
    seed: Count
    renderer: Text
    config: dict[str, Any]
    """Values of the fields of `ReconstructorConfig`, by name."""
    training: dict[str, Any]
    """Values of the fields of `LiveTraining`, by name."""
    camera: CameraRecord
    stereo: bool = False
    """True if the reconstructor was created for stereo frames."""


class SceneBegun(Record):
    """Schedule line of a call of `Reconstructor.begin_scene`."""

    event: Literal["begin_scene"] = "begin_scene"
    seq: Count
    anew: bool = False
    """True if the model of the same scene was started anew."""


class Observed(Record):
    """Schedule line of a call of `Reconstructor.observe`, followed by `publish`."""

    event: Literal["observe"] = "observe"
    seq: Count
    steps: Steps
    train: bool


class DepthTaken(Record):
    """Schedule line of a call of `Reconstructor.take_depth` with an already observed frame and its late depth."""

    event: Literal["take_depth"] = "take_depth"
    seq: Count
    origin: Origin
    error: NotNegative | None = None
    """Relative standard error of the depth; None if unknown, or in recordings of earlier versions."""
    width_px: Side
    height_px: Side
    tracks: Tracks
    """Timestamps of the late depth in the track `depth`, and in `depth_confidence` if available."""


class Grown(Record):
    """Schedule line of a call of `Reconstructor.grow` with the last observed frame."""

    event: Literal["grow"] = "grow"
    seq: Count


class Rehearsed(Record):
    """Schedule line of a call of `Reconstructor.rehearse`."""

    event: Literal["rehearse"] = "rehearse"
    steps: Steps


ScheduleLine = ReconstructorMade | SceneBegun | Observed | DepthTaken | Grown | Rehearsed
SCHEDULE_LINES = (ReconstructorMade, SceneBegun, Observed, DepthTaken, Grown, Rehearsed)
LOG_FILE = "log.jsonl"
MAX_LINE_BYTES = 1 << 20
Line = (
    SegmentBegins | FrameLine | PreparedLine | ShownLine | LostLine | DeletedLine | NoteLine | SegmentEnds
    | ReconstructorMade | SceneBegun | Observed | DepthTaken | Grown | Rehearsed
)  # fmt: skip
_LINES: TypeAdapter[Line] = TypeAdapter(Annotated[Line, Field(discriminator="event")])
_UNKNOWN_EVENT = "union_tag_invalid"


class LogWriter:
    """Writer that appends lines to a new file; methods raise OSError."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self.bytes = 0

    def write(self, line: Record) -> None:
        """Append one line."""
        data = line.as_json() + b"\n"
        written = self._file.write(data)
        self.bytes += written
        # A disk that fills up may accept a part of the line. The next write then raises the error.
        if written != len(data):
            self.bytes += self._file.write(data[written:])

    def sync(self) -> None:
        """Force written data to the disk."""
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Close the file; repeated calls have no effect."""
        self._file.close()


def read_log(path: Path) -> Iterator[Line]:
    """Yield the lines of a log up to the first truncated or invalid one.

    Lines with an unknown event are skipped.

    Raises:
        UnreadableFile: if the log is not a regular file.
        OSError: if reading fails.
    """
    with open_plain(path) as file:
        while True:
            data = file.readline(MAX_LINE_BYTES)
            if not data.endswith(b"\n"):
                return  # end of file, or a truncated or overlong line
            try:
                yield _LINES.validate_json(data)
            except ValidationError as error:
                if [each["type"] for each in error.errors(include_input=False)] != [_UNKNOWN_EVENT]:
                    return


SESSION_FILE = "session.json"
SEGMENTS_FOLDER = "segments"
FORMAT = "intrasplat-session"
VERSION = 1
MAX_BYTES = 1 << 20


class SessionInfo(Record):
    """Content of `session.json`."""

    format: Literal["intrasplat-session"] = "intrasplat-session"
    version: Literal[1] = 1
    source: Text
    """Human-readable description of the frame source."""
    utc: Text
    """Start of the recording in ISO 8601."""
    fps: float = Field(gt=0, le=10_000)
    """Nominal frame rate in Hz."""
    camera: CameraRecord
    """Camera of the first frame."""
    fields: tuple[Literal["mask", "depth", "right_image", "pose"], ...] = ()
    """Optional fields that every frame of the source has."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings of the run, as free-form data."""
    keeps_bytes: Count | None = None
    """Size limit in bytes beyond which the oldest segments are deleted; None for no limit."""
    keeps_s: float | None = Field(default=None, ge=0)
    """Age limit in seconds beyond which segments are deleted; None for no limit."""


def write_session_file(folder: Path, info: SessionInfo) -> None:
    """Write the session file atomically.

    Raises:
        FileExistsError: if the folder already contains a session file.
        OSError: if writing fails.
    """
    with PartialFile(folder / SESSION_FILE, overwrite=False) as partial:
        partial.file.write(info.model_dump_json(indent=1, exclude_none=True).encode() + b"\n")


COPY_AGAIN = "Copy the session again from its source"


def read_session_file(folder: Path) -> SessionInfo:
    """Read and validate the session file.

    Raises:
        RecordingInvalid: if the file is missing, unreadable or invalid.
    """
    path = folder / SESSION_FILE
    try:
        if os.path.islink(path):
            raise UnreadableFile("it is a link")
        with open_plain(path) as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise UnreadableFile(f"it has more bytes than the bound of {MAX_BYTES}")
        info = SessionInfo.model_validate_json(data)
        camera_of(info.camera)
    except (UnreadableFile, OSError, InvalidInput) as error:
        raise RecordingInvalid(f"{printable(path)}: {error}. {COPY_AGAIN}.") from error
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise RecordingInvalid(
            f"{printable(path)}: {where}: {first['msg']:.200}; this version reads {FORMAT} {VERSION}. {COPY_AGAIN}."
        ) from error
    return info
