"""Messages between a capture process and its parent: JSON, with frame arrays in shared memory."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame, FrameStatus
from operators.sources.options import SourceOptions
from operators.sources.shared_memory import PLANES, BadHeader
from operators.sources.source import SourceDescription

MOST_BYTES = 1 << 20
"""Maximum size of a message in bytes."""


def message(kind: str, **content: Any) -> bytes:
    """Encode a message."""
    return json.dumps({"kind": kind, **content}).encode()


def parsed(data: bytes) -> dict[str, Any]:
    """Decode a message. Raises BadHeader."""
    try:
        content = json.loads(data)
    except ValueError as error:
        raise BadHeader(f"{data[:40]!r} is not JSON: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("kind"), str):
        raise BadHeader(f"{data[:40]!r} is not a message")
    return content


def options_to(options: SourceOptions) -> dict[str, Any]:
    """Convert options to JSON values."""
    return asdict(options)


def options_from(content: dict[str, Any]) -> SourceOptions:
    """Create options from JSON values."""
    return SourceOptions(**content)


def description_to(about: SourceDescription) -> dict[str, Any]:
    """Convert a description to JSON values."""
    return {
        "name": about.name,
        "width_px": about.width_px,
        "height_px": about.height_px,
        "fps": about.fps,
        "camera": camera_to(about.camera),
        "fields": sorted(about.fields),
        "frame_count": about.frame_count,
        "notes": list(about.notes),
    }


def camera_to(camera: Camera) -> dict[str, Any]:
    """Convert a camera to JSON values."""
    return {
        "K": camera.K.tolist(),
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "world_to_camera": camera.world_to_camera.tolist(),
        "model": camera.model,
    }


def description_from(content: dict[str, Any]) -> SourceDescription:
    """Create a description from JSON values. Raises BadHeader."""
    try:
        camera = Camera(**content["camera"])
        fields, notes = frozenset(content["fields"]), tuple(content["notes"])
        return SourceDescription(**{**content, "camera": camera, "fields": fields, "notes": notes})
    except (KeyError, TypeError, ValueError) as error:
        raise BadHeader(f"this describes no source: {error}") from error


def planes_of(frame: Frame) -> dict[str, NDArray]:
    """Return the arrays of a frame by field."""
    planes = {name: getattr(frame, name) for name in PLANES}
    return {name: plane for name, plane in planes.items() if plane is not None}


def frame_header(frame: Frame) -> dict[str, Any]:
    """Return the fields of a frame other than arrays as JSON values."""
    return {
        "seq": frame.seq,
        "pts_ns": frame.pts_ns,
        "arrived_ns": frame.arrived_ns,
        "status": frame.status.value,
        "damage": frame.damage,
        "depth_origin": None if frame.depth_origin is None else frame.depth_origin.value,
        "right_camera": None if frame.right_camera is None else camera_to(frame.right_camera),
    }


def frame_from(header: Mapping[str, Any], planes: Mapping[str, Any]) -> Frame:
    """Create a frame from its header and arrays. Raises BadHeader."""
    try:
        seq, pts_ns, arrived_ns, damage = (header[name] for name in ("seq", "pts_ns", "arrived_ns", "damage"))
        whole = all(type(value) is int and abs(value) < 2**62 for value in (seq, pts_ns))
        if not whole or not isinstance(damage, str | None) or type(arrived_ns) not in (int, type(None)):
            raise BadHeader(f"a frame cannot have the number {seq!r:.30} and the time {pts_ns!r:.30}")
        origin, right_camera = header.get("depth_origin"), header.get("right_camera")
        return Frame(
            seq=seq,
            pts_ns=pts_ns,
            arrived_ns=arrived_ns,
            status=FrameStatus(header["status"]),
            damage=damage,
            depth_origin=None if origin is None else DepthOrigin(origin),
            right_camera=None if right_camera is None else Camera(**right_camera),
            **planes,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise BadHeader(f"this is no frame: {error}") from error


def finite_counts(content: Any) -> dict[str, int]:
    """Return the valid counts of a JSON object; empty if it is not an object."""
    if not isinstance(content, dict):
        return {}
    return {str(name): int(times) for name, times in content.items() if isinstance(times, int) and math.isfinite(times)}


def as_contiguous(planes: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return the arrays in contiguous memory."""
    return {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
