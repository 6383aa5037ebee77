"""The lines of a session's log: one JSON object each, with its kind under `event`.

    segment      a segment begins                    frame      a frame came in
    prepared     what training was given of it       shown      a picture was shown
    lost         something could not be recorded     deleted    an older segment was removed
    note         a sentence                          end        the segment is complete

The lines that say what was trained, `reconstructor`, `observe`, `take_depth`, `grow`, `rehearse` and `begin_scene`, are in `schedule`. A reader leaves out
lines whose `event` it does not know.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

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
"""[4, 4] row by row, OpenCV axes."""
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

TrackName = Literal["image", "right_image", "mask", "loss_mask", "rehearsal_mask", "depth", "depth_confidence", "shown"]
Tracks = dict[TrackName, Count]
"""For each track that has a picture for this line, the time in milliseconds at which it lies in the track's file."""


Origin = Literal["measured", "stereo", "parallax", "light"]
"""See `gsplat_core.scene.frames.DepthOrigin`."""


class Record(BaseModel):
    """One line of a log; frozen, and checked whoever wrote it."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)

    def line(self) -> bytes:
        """As it is written, the end of the line included."""
        return self.model_dump_json(exclude_none=True).encode() + b"\n"


class CameraRecord(Record):
    """Intrinsics, size and pose of a camera: see `gsplat_core.scene.cameras.Camera`."""

    model: Literal["pinhole", "ortho", "fisheye"] = "pinhole"
    width_px: Side
    height_px: Side
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    world_to_camera: Pose


class SegmentBegins(Record):
    """The first line of each log."""

    event: Literal["segment"] = "segment"
    number: Count
    why: Text
    """What ended the segment before: "begin", "bytes", "seconds"."""
    utc: Text
    """Date and time of day by the machine's clock, for people: ISO 8601."""
    monotonic_ns: Nanoseconds
    """The same moment on the clock of `arrived_ns` and `shown_ns`."""


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
    """The right eye's; its pose leads from the left camera's coordinates to its own."""
    depth_origin: Origin | None = None
    """Absent where there is no depth, or in recordings of earlier versions."""
    arrived_ns: Nanoseconds | None = None
    exposure: tuple[Positive, Positive, Positive] | None = None
    withheld: Text | None = None
    new_scene: Text | None = None


class FrameLine(_FrameLine):
    """A frame as it came in: behind the out-of-body gate and what looks at the picture beside it."""

    event: Literal["frame"] = "frame"


class PreparedLine(_FrameLine):
    """The same frame as training was given it. A track that is missing here and there in `same` is that of the frame as it came in."""

    event: Literal["prepared"] = "prepared"
    same: tuple[TrackName, ...]


class ShownLine(Record):
    """A picture that was shown."""

    event: Literal["shown"] = "shown"
    seq: Count
    """The frame whose content it shows."""
    width_px: Side
    height_px: Side
    model_version: Count
    sha256: Digest | None = None
    """Of the RGB bytes of the rendered picture, before state and age are drawn into it; absent: the picture was there before, and only its
    state or age has changed."""
    shown_ns: Nanoseconds | None = None
    age_ns: Nanoseconds | None = None
    """From the arrival of the newest frame that it shows until it was shown."""
    state: Text | None = None
    tracks: Tracks
    """`shown`: the picture as it was on the screen."""


class LostLine(Record):
    """Something that should stand here and does not, because writing was too slow for it, or because no line can hold it."""

    event: Literal["lost"] = "lost"
    seq: Count
    what: Literal["frame", "prepared", "shown", "depth"]
    why: Text


class DeletedLine(Record):
    """An older segment that was removed to keep the recording within its bounds."""

    event: Literal["deleted"] = "deleted"
    segment: Count
    bytes: Count


class NoteLine(Record):
    """A sentence about the recording."""

    event: Literal["note"] = "note"
    text: Text


class SegmentEnds(Record):
    """The last line of a log that is complete."""

    event: Literal["end"] = "end"
    why: Text
    """"bytes" and "seconds": the next segment goes on; anything else: why the recording ends."""
    frames: Count
    """How many `frame` lines the segment has."""
