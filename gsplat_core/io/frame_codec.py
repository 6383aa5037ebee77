"""Codec of frames: a fixed header, raw arrays and typed fields, without pickle.

All transports use this codec. Between the project's processes a frame is a sequence of pieces, which shared memory and
sockets transfer without joining them. A message of another program is one buffer without fields. The log of a recorded
session has the same fields in each line, and its arrays are in video files.

| bytes | type | content |
|---|---|---|
| 0-3 | `ISPF` | |
| 4-5 | uint16 | version, 1 |
| 6-7 | uint16 | arrays after the image, as bits of `ARRAYS`; 0x8000 if fields follow the arrays |
| 8-11, 12-15 | uint32 | width and height in pixels |
| 16-23 | uint64 | sequence number |
| 24-31 | int64 | presentation timestamp in nanoseconds |
| 32- | | arrays in the order of `ARRAYS`, then the fields as JSON |

The arrays of a message are the image, uint8 [H, W, 3] RGB, and optionally the right image of the same form, depth float32
[H, W] in mm, mask uint8 [H, W], and pose float64 [4, 4] world to camera. All values are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame, FrameStatus

MOST_NS = 2**62
MAX_SIDE_PX = 65_536
MAX_TEXT = 1_000
Count = Annotated[int, Field(ge=0, le=MOST_NS)]
Nanoseconds = Annotated[int, Field(ge=-MOST_NS, le=MOST_NS)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]
Text = Annotated[str, Field(max_length=MAX_TEXT)]
Number = Annotated[float, Field(ge=-1e9, le=1e9)]
Positive = Annotated[float, Field(gt=0, le=1e9)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class InvalidMessage(Exception):
    """Received data that are not a valid frame, or not a valid message between processes."""


class ArrayFormat(NamedTuple):
    """Format of an array field of a frame."""

    bit: int
    """Bit of the message header that is set if the frame has this array; 0 for the image, which every frame has."""
    kind: str
    """Data type of the values, little-endian."""
    values: int
    """Number of values per pixel; 0 for the pose, which is a matrix [4, 4] and not a picture."""

    def shape(self, height_px: int, width_px: int) -> tuple[int, ...]:
        """Return the array's shape in a frame of this size."""
        if self.values == 0:
            return 4, 4
        return (height_px, width_px) if self.values == 1 else (height_px, width_px, self.values)


ARRAYS: Mapping[str, ArrayFormat] = {
    "image": ArrayFormat(0, "<u1", 3),
    "right_image": ArrayFormat(1, "<u1", 3),
    "depth": ArrayFormat(2, "<f4", 1),
    "mask": ArrayFormat(4, "<u1", 1),
    "pose": ArrayFormat(8, "<f8", 0),
    "depth_confidence": ArrayFormat(16, "<f4", 1),
    "loss_mask": ArrayFormat(32, "<u1", 1),
}
"""Array fields of `Frame`, in the order of a message."""
MAGIC, VERSION = b"ISPF", 1
HEADER = struct.Struct("<4sHHIIQq")
WITH_FIELDS = 0x8000
MAX_FIELDS_BYTES = 1 << 16
MAX_PIECES = 2 + len(ARRAYS)
MAX_PIXELS = 2**26
MESSAGE_ARRAYS = ("image", "right_image", "depth", "mask", "pose")
"""Names of the array fields that messages of other programs may have."""
MAX_MESSAGE_PIXELS = 2**24
"""Maximum number of pixels of a picture from another program, 4096x4096, which bounds the size of a message."""


def _bytes_of(names: Iterable[str], pixels: int) -> int:
    return sum(np.dtype(ARRAYS[name].kind).itemsize * (ARRAYS[name].values * pixels or 16) for name in names)


MAX_MESSAGE_BYTES = HEADER.size + _bytes_of(MESSAGE_ARRAYS, MAX_MESSAGE_PIXELS)
MAX_FRAME_BYTES = HEADER.size + _bytes_of(ARRAYS, MAX_PIXELS) + MAX_FIELDS_BYTES


def _is_pose(rows: tuple[float, ...]) -> tuple[float, ...]:
    if rows[12:] != (0, 0, 0, 1):
        raise ValueError(f"the last row of a pose must be 0, 0, 0, 1, got {rows[12:]}")
    return rows


def _is_origin(name: str) -> str:
    DEPTH_ORIGINS.check(name)
    return name


Pose = Annotated[tuple[Number, ...], Field(min_length=16, max_length=16), AfterValidator(_is_pose)]
"""World-to-camera matrix [4, 4] as 16 numbers in row-major order, OpenCV axes."""
Origin = Annotated[Text, AfterValidator(_is_origin)]
"""Name of a depth origin, a key of `DEPTH_ORIGINS`."""


class Record(BaseModel):
    """Immutable JSON object, validated on construction and on reading."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)

    def as_json(self) -> bytes:
        """Return the JSON text without fields that are None."""
        return self.model_dump_json(exclude_none=True).encode()


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


class FrameFields(Record):
    """Fields of a frame other than its arrays, number and timestamp. The receiver assigns the scene id."""

    status: FrameStatus = FrameStatus.LIVE
    damage: Text | None = None
    right_camera: CameraRecord | None = None
    """Camera of the right eye; its pose maps left-camera coordinates to its own."""
    depth_origin: Origin | None = None
    """Origin of the depth, such as `stereo` or `learned`; None if the frame has no depth, or in recordings of earlier versions."""
    depth_error: NotNegative | None = None
    """Relative standard error of the depth; None if unknown, or in recordings of earlier versions."""
    arrived_ns: Nanoseconds | None = None
    withheld: Text | None = None
    new_scene: Text | None = None


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


_Name = TypeVar("_Name", bound=str)


def arrays_of(frame: Frame, names: Iterable[_Name]) -> dict[_Name, NDArray[Any]]:
    """Return those of the array fields `names` that are not None in a frame, by name."""
    return {name: array for name in names if (array := getattr(frame, name)) is not None}


def fields_of(frame: Frame) -> dict[str, Any]:
    """Return the values of a frame for the fields of `FrameFields`, by name. Long texts are cut."""
    return {
        "status": frame.status,
        "damage": short(frame.damage),
        "right_camera": None if frame.right_camera is None else camera_record(frame.right_camera),
        "depth_origin": None if frame.depth_origin is None else frame.depth_origin.name,
        "depth_error": frame.depth_error,
        "arrived_ns": frame.arrived_ns,
        "withheld": short(frame.withheld),
        "new_scene": short(frame.new_scene),
    }


def short(text: str | None) -> str | None:
    """Return the text, cut to the length of `Text`; None for None."""
    return None if text is None else text[:MAX_TEXT]


def frame_from(seq: int, pts_ns: int, fields: FrameFields, arrays: Mapping[str, NDArray[Any]], **changes: Any) -> Frame:
    """Create a frame from its fields and arrays.

    Args:
        seq: sequence number.
        pts_ns: timestamp in nanoseconds.
        fields: remaining fields.
        arrays: arrays by field; other names are ignored.
        changes: fields of `Frame` that replace those of `fields`.

    Raises:
        InvalidInput: if the parts do not fit together.
    """
    taken = {
        "status": fields.status,
        "damage": fields.damage,
        "right_camera": None if fields.right_camera is None else camera_of(fields.right_camera),
        "depth_origin": None if fields.depth_origin is None else DEPTH_ORIGINS[fields.depth_origin],
        "depth_error": fields.depth_error,
        "arrived_ns": fields.arrived_ns,
        "withheld": fields.withheld,
        "new_scene": fields.new_scene,
        **{name: arrays[name] for name in ARRAYS if name in arrays},
    }
    return Frame(seq=seq, pts_ns=pts_ns, **{**taken, **changes})


def encode(frame: Frame) -> list[bytes | memoryview]:
    """Encode a frame as pieces: header, arrays, fields.

    Contiguous arrays are not copied, so they must not be modified until the pieces are sent.

    Raises:
        ValueError: the picture is too large, or a value cannot be encoded.
    """
    arrays = arrays_of(frame, ARRAYS)
    fields = FrameFields(**fields_of(frame)).as_json()
    return [*_packed(frame.seq, frame.pts_ns, arrays, MAX_PIXELS, WITH_FIELDS), fields]


def decode(pieces: Sequence[memoryview]) -> Frame:
    """Decode a frame from the pieces of `encode`. Its arrays refer to their memory.

    Raises:
        InvalidMessage: the pieces are not a frame.
    """
    if not pieces:
        raise InvalidMessage("it has no pieces")
    if len(pieces[0]) != HEADER.size:
        raise InvalidMessage(f"its header has {len(pieces[0])} bytes in place of {HEADER.size}")
    seq, pts_ns, bits, announced = _announced(pieces[0], ARRAYS, MAX_PIXELS)
    if not bits & WITH_FIELDS:
        raise InvalidMessage("its header announces no fields")
    sizes, found = [size for _, _, size in announced], [len(piece) for piece in pieces[1:]]
    if len(found) != len(sizes) + 1 or found[:-1] != sizes:
        raise InvalidMessage(
            f"its pieces have {found} bytes; its header announces arrays of {sizes} bytes and the fields"
        )
    if found[-1] > MAX_FIELDS_BYTES:
        raise InvalidMessage(f"its fields have {found[-1]} bytes; at most {MAX_FIELDS_BYTES} are read")
    try:
        fields = FrameFields.model_validate_json(bytes(pieces[-1]))
        return frame_from(seq, pts_ns, fields, _arrays(announced, pieces[1:-1]))
    except (ValidationError, InvalidInput) as error:
        raise InvalidMessage(f"its fields are not those of a frame: {error}") from error


def encode_message(seq: int, pts_ns: int, arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Encode a frame as one buffer without fields, as other programs send it.

    Args:
        seq: sequence number.
        pts_ns: timestamp in nanoseconds.
        arrays: `image` [H, W, 3], and optionally the other arrays of `MESSAGE_ARRAYS` for the same size.

    Raises:
        ValueError: shapes do not match, or the picture is too large.
    """
    given = {name: arrays[name] for name in MESSAGE_ARRAYS if name in arrays}
    return b"".join(_packed(seq, pts_ns, given, MAX_MESSAGE_PIXELS))


def decode_message(data: memoryview, **changes: Any) -> Frame:
    """Decode a message of another program. The frame's arrays refer to its memory.

    The header is validated before memory is allocated.

    Args:
        data: the message.
        changes: fields of `Frame` that a message does not have.

    Raises:
        InvalidMessage: the message is not a frame.
    """
    if len(data) < HEADER.size:
        raise InvalidMessage(f"it has {len(data)} bytes, less than a header")
    seq, pts_ns, bits, announced = _announced(data, MESSAGE_ARRAYS, MAX_MESSAGE_PIXELS)
    if bits & WITH_FIELDS:
        raise InvalidMessage("it has fields, which are not read from other programs")
    found: list[memoryview] = []
    begin = HEADER.size
    for name, _, size in announced:
        if begin + size > len(data):
            raise InvalidMessage(f"it ends within {name}: it has {len(data)} bytes")
        found.append(data[begin : begin + size])
        begin += size
    if begin != len(data):
        raise InvalidMessage(f"it has {len(data)} bytes; its header says {begin}")
    return Frame(seq=seq, pts_ns=pts_ns, **_arrays(announced, found), **changes)


def _packed(
    seq: int, pts_ns: int, arrays: Mapping[str, NDArray[Any]], max_pixels: int, bits: int = 0
) -> list[bytes | memoryview]:
    height_px, width_px = arrays["image"].shape[:2]
    if not 0 < width_px * height_px <= max_pixels:
        raise ValueError(f"a picture of {width_px}x{height_px} px is not sent; at most {max_pixels} pixels are")
    pieces: list[bytes | memoryview] = [b""]
    for name, array in arrays.items():
        shape = ARRAYS[name].shape(height_px, width_px)
        if array.shape != shape:
            raise ValueError(f"{name} is {list(array.shape)}; with this image it must be {list(shape)}")
        bits |= ARRAYS[name].bit
        pieces.append(np.ascontiguousarray(array, ARRAYS[name].kind).reshape(-1).view(np.uint8).data)
    pieces[0] = HEADER.pack(MAGIC, VERSION, bits, width_px, height_px, seq, pts_ns)
    return pieces


_Announced = list[tuple[str, tuple[int, ...], int]]
"""Field name, shape and size in bytes of each array of a message, according to the message's header."""


def _announced(data: memoryview, names: Iterable[str], max_pixels: int) -> tuple[int, int, int, _Announced]:
    """Return number, timestamp, bits and arrays of a header, restricted to arrays of `names`. Raises InvalidMessage."""
    magic, version, bits, width_px, height_px, seq, pts_ns = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise InvalidMessage(f"it begins with {bytes(magic)!r} in place of {MAGIC!r}")
    if version != VERSION:
        raise InvalidMessage(f"it has version {version}; {VERSION} is read")
    if bits & ~sum((ARRAYS[name].bit for name in names), WITH_FIELDS):
        raise InvalidMessage(f"it has arrays that are not known ({bits:#06x})")
    if not 0 < width_px * height_px <= max_pixels:
        raise InvalidMessage(f"its picture has {width_px}x{height_px} px; at most {max_pixels} pixels are read")
    if seq >= MOST_NS or abs(pts_ns) >= MOST_NS:
        raise InvalidMessage(f"its number {seq} or its time {pts_ns} is out of range")
    announced = []
    for name, (bit, kind, _) in ARRAYS.items():
        if not bit or bits & bit:
            shape = ARRAYS[name].shape(height_px, width_px)
            announced.append((name, shape, int(np.prod(shape)) * np.dtype(kind).itemsize))
    return seq, pts_ns, bits, announced


def _arrays(announced: _Announced, found: Sequence[memoryview]) -> dict[str, Any]:
    return {
        name: np.frombuffer(piece, ARRAYS[name].kind).reshape(shape)
        for (name, shape, _), piece in zip(announced, found, strict=True)
    }
