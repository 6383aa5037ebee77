"""`session.json`: what is known about a session when its recording begins."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from gsplat_core.errors import InvalidInput, RecordingInvalid
from gsplat_core.io.files import PartialFile
from gsplat_core.io.recordings.findings import printable
from gsplat_core.io.recordings.plain_files import UnreadableFile, open_plain
from gsplat_core.io.sessions.records import CameraRecord, Count, Record, Text
from gsplat_core.scene.cameras import Camera

SESSION_FILE = "session.json"
SEGMENTS_FOLDER = "segments"
FORMAT = "intrasplat-session"
VERSION = 1
MAX_BYTES = 1 << 20


class SessionInfo(Record):
    """The whole of `session.json`."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)

    format: Literal["intrasplat-session"] = "intrasplat-session"
    version: Literal[1] = 1
    source: Text
    """Where the frames came from, in words."""
    utc: Text
    """When the recording began: ISO 8601."""
    fps: float = Field(gt=0, le=10_000)
    """Nominal frames per second."""
    camera: CameraRecord
    """The camera of the first frame."""
    fields: tuple[Literal["mask", "depth", "right_image", "pose"], ...] = ()
    """What every frame of the source has."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """The settings of the run, for people and programs that know them."""
    keeps_bytes: Count | None = None
    """Segments beyond so many bytes are deleted, the oldest first; absent: none."""
    keeps_s: float | None = Field(default=None, ge=0)
    """Segments that ended longer ago are deleted; absent: none."""


def camera_record(camera: Camera) -> CameraRecord:
    """A camera as it is written."""
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
    """The camera that was written. Raises InvalidInput for one that cannot be."""
    K = np.array([[record.fx, 0, record.cx], [0, record.fy, record.cy], [0, 0, 1]])
    pose = np.array(record.world_to_camera).reshape(4, 4)
    return Camera(K, record.width_px, record.height_px, pose, record.model)


def write_session_file(folder: Path, info: SessionInfo) -> None:
    """Write it whole, in a folder where there is none yet. Raises FileExistsError, OSError."""
    with PartialFile(folder / SESSION_FILE, overwrite=False) as partial:
        partial.file.write(info.model_dump_json(indent=1, exclude_none=True).encode() + b"\n")


def read_session_file(folder: Path) -> SessionInfo:
    """Raises RecordingInvalid for what is no such file."""
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
