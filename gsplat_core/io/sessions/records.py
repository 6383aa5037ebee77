"""Records of a session's recording: the lines of its log, the schedule of training calls, and `session.json`.

A log is JSON lines, one object each with its kind under `event`. Each line is written by one system call, so only the last one can be cut. The schedule
lists the training calls of a live session so that replay can repeat them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from gsplat_core.errors import InvalidInput, RecordingInvalid
from gsplat_core.io.files import PartialFile
from gsplat_core.io.recordings.findings import printable
from gsplat_core.io.recordings.plain_files import UnreadableFile, open_plain
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.depth_origin import DEPTH_ORIGINS

MOST_NS = 2**62
MAX_SIDE_PX = 65_536
MAX_TEXT = 1_000
Count = Annotated[int, Field(ge=0, le=MOST_NS)]
Nanoseconds = Annotated[int, Field(ge=-MOST_NS, le=MOST_NS)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]
Text = Annotated[str, Field(max_length=MAX_TEXT)]
Number = Annotated[float, Field(ge=-1e9, le=1e9)]
Positive = Annotated[float, Field(gt=0, le=1e9)]


def _is_pose(rows: tuple[float, ...]) -> tuple[float, ...]:
    if rows[12:] != (0, 0, 0, 1):
        raise ValueError(f"the last row of a pose must be 0, 0, 0, 1, got {rows[12:]}")
    return rows


Pose = Annotated[tuple[Number, ...], Field(min_length=16, max_length=16), AfterValidator(_is_pose)]
"""Matrix [4, 4] in row-major order, OpenCV axes."""
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
TrackName = Literal["image", "right_image", "mask", "loss_mask", "rehearsal_mask", "depth", "depth_confidence", "shown"]
Tracks = dict[TrackName, Count]
"""Timestamp in milliseconds within the track's file, for each track with a picture of this line."""


def _is_origin(name: str) -> str:
    DEPTH_ORIGINS.check(name)
    return name


Origin = Annotated[str, AfterValidator(_is_origin)]
"""Name in `DEPTH_ORIGINS`."""


class Record(BaseModel):
    """One line of a session log; immutable and validated on construction and on reading."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)

    def line(self) -> bytes:
        """Return the JSON line as bytes, including the newline."""
        return self.model_dump_json(exclude_none=True).encode() + b"\n"


class CameraRecord(Record):
    """Intrinsics, size and pose of a camera; see `gsplat_core.scene.cameras.Camera`."""

    model: Literal["pinhole", "ortho", "fisheye"] = "pinhole"
    width_px: Side
    height_px: Side
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    world_to_camera: Pose


class SegmentBegins(Record):
    """First line of each log."""

    event: Literal["segment"] = "segment"
    number: Count
    why: Text
    """Reason for ending the previous segment: "begin", "bytes" or "seconds"."""
    utc: Text
    """Wall-clock date and time in ISO 8601."""
    monotonic_ns: Nanoseconds
    """The same moment on the monotonic clock of `arrived_ns` and `shown_ns`."""


class _FrameLine(Record):
    event: str
    seq: Count
    pts_ns: Nanoseconds
    width_px: Side
    height_px: Side
    tracks: Tracks
    status: Literal["live", "replay", "stale", "damaged"] = "live"
    damage: Text | None = None
    pose: Pose | None = None
    """World-to-camera."""
    right_camera: CameraRecord | None = None
    """Camera of the right eye; its pose maps left-camera coordinates to its own."""
    depth_origin: Origin | None = None
    """None if the frame has no depth, or in recordings of earlier versions."""
    arrived_ns: Nanoseconds | None = None
    exposure: tuple[Positive, Positive, Positive] | None = None
    withheld: Text | None = None
    new_scene: Text | None = None


class FrameLine(_FrameLine):
    """Frame as received, after the out-of-body gate and the concurrent image checks."""

    event: Literal["frame"] = "frame"


class PreparedLine(_FrameLine):
    """Frame as passed to training.

    A plane without a track here, but listed in `same`, equals that of the received frame.
    """

    event: Literal["prepared"] = "prepared"
    same: tuple[TrackName, ...]


class ShownLine(Record):
    """Displayed picture."""

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
    """Time from the arrival of the newest frame in the picture until its display."""
    state: Text | None = None
    tracks: Tracks
    """Track `shown` with the picture as displayed."""


class LostLine(Record):
    """Marker for a record that was not written.

    Reasons are writing that was too slow, or a record that does not fit into a line.
    """

    event: Literal["lost"] = "lost"
    seq: Count
    what: Literal["frame", "prepared", "shown", "depth"]
    why: Text


class DeletedLine(Record):
    """Older segment that was deleted to keep the recording within its limits."""

    event: Literal["deleted"] = "deleted"
    segment: Count
    bytes: Count


class NoteLine(Record):
    """Human-readable remark."""

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
    """Creation of a reconstructor: at the start, or after a restart of an operator."""

    event: Literal["reconstructor"] = "reconstructor"
    device: Text
    seed: Count
    renderer: Text
    config: dict[str, Any]
    """Fields of `ReconstructorConfig`."""
    training: dict[str, Any]
    """Fields of `LiveTraining`."""
    camera: CameraRecord
    stereo: bool = False
    """True if the reconstructor was created for stereo frames."""


class SceneBegun(Record):
    """Call of `Reconstructor.begin_scene`."""

    event: Literal["begin_scene"] = "begin_scene"
    seq: Count


class Observed(Record):
    """Calls of `Reconstructor.observe` and then `publish`."""

    event: Literal["observe"] = "observe"
    seq: Count
    steps: Steps
    train: bool


class DepthTaken(Record):
    """Call of `Reconstructor.take_depth` with an already observed frame and its late depth."""

    event: Literal["take_depth"] = "take_depth"
    seq: Count
    origin: Origin
    width_px: Side
    height_px: Side
    tracks: Tracks
    """`depth`, and `depth_confidence` if available."""


class Grown(Record):
    """Call of `Reconstructor.grow` with the last observed frame."""

    event: Literal["grow"] = "grow"
    seq: Count


class Rehearsed(Record):
    """Call of `Reconstructor.rehearse`."""

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
        data = line.line()
        written = self._file.write(data)
        self.bytes += written
        # a disk that fills up accepts a part; the next write raises the error
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

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)

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


def camera_record(camera: Camera) -> CameraRecord:
    """Convert a camera to its record."""
    return CameraRecord(
        model=camera.model,
        width_px=camera.width_px,
        height_px=camera.height_px,
        fx=float(camera.K[0, 0]),
        fy=float(camera.K[1, 1]),
        cx=float(camera.K[0, 2]),
        cy=float(camera.K[1, 2]),
        world_to_camera=tuple(camera.world_to_camera.ravel().tolist()),
    )


def camera_of(record: CameraRecord) -> Camera:
    """Convert a record to a camera.

    Raises:
        InvalidInput: if the values are invalid.
    """
    K = np.array([[record.fx, 0, record.cx], [0, record.fy, record.cy], [0, 0, 1]])
    pose = np.array(record.world_to_camera).reshape(4, 4)
    return Camera(K, record.width_px, record.height_px, pose, record.model)


def write_session_file(folder: Path, info: SessionInfo) -> None:
    """Write the session file atomically.

    Raises:
        FileExistsError: if the folder already contains a session file.
        OSError: if writing fails.
    """
    with PartialFile(folder / SESSION_FILE, overwrite=False) as partial:
        partial.file.write(info.model_dump_json(indent=1, exclude_none=True).encode() + b"\n")


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
        raise RecordingInvalid(f"{printable(path)}: {error}. Copy the session again from its source.") from error
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise RecordingInvalid(
            f"{printable(path)}: {where}: {first['msg']:.200}. This version reads {FORMAT} {VERSION}; copy the session again from its source."
        ) from error
    return info
