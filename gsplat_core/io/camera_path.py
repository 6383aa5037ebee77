"""Camera path read from JSON: key poses with geodesic rotation and linear translation between.

{"cameras": [
  {"time_s": 0.0, "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
  {"time_s": 1.5, "camera_to_world": [[...], [...], [...], [0, 0, 0, 1]]}
]}

Axes are the camera's (x right, y down, z forward), lengths the scene's, times the model's in
seconds. `intrinsics` {"fx", "fy", "cx", "cy"}, in pixels of the model's camera, may be given for
all cameras or for none. Linear motion does not overshoot into tissue, as smoother curves would.

The `cameras.json` that the INRIA trainer writes next to a `.ply` is read, too: a list of cameras with `position`,
`rotation` (camera to world), `fx`, `fy`, `width` and `height`. They follow each other by one second.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import BundleCorrupt, InvalidInput, InvalidSetting
from gsplat_core.io.files import read_regular
from gsplat_core.scene.cameras import MAX_INTRINSICS_PX, MIN_FOCAL_PX, Camera
from gsplat_core.value_ranges import IntegerIn, JsonObject, NumberIn

MOST_BYTES = 1 << 24
MOST_CAMERAS = 100_000
TIME_S = NumberIn(-1e10, 1e10)
PLACE = NumberIn(-1e9, 1e9)
FOCAL_PX = NumberIn(MIN_FOCAL_PX, MAX_INTRINSICS_PX)
CENTRE_PX = NumberIn(-MAX_INTRINSICS_PX, MAX_INTRINSICS_PX)
HEIGHT_PX = IntegerIn(1, 1 << 16)
ROTATION_TOLERANCE = 2e-3
INTRINSICS = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": CENTRE_PX, "cy": CENTRE_PX}


@dataclass(frozen=True, eq=False)
class Waypoint:
    """Camera pose at a time of the path, optionally with intrinsics."""

    time_s: float
    camera_to_world: NDArray[np.float64]
    """Camera-to-world pose [4, 4]."""
    intrinsics: tuple[float, ...] | None = None
    """fx, fy, cx and cy in pixels; None to keep the intrinsics of the camera that follows the path."""
    height_px: int | None = None
    """Height of the picture that `intrinsics` belong to, which has its principal point in the middle. None for
    intrinsics of the camera that follows the path."""


class CameraPath:
    """Camera poses over time, interpolated between waypoints.

    Raises:
        InvalidInput: if times do not increase, or only some waypoints have intrinsics.
    """

    def __init__(self, waypoints: list[Waypoint]) -> None:
        if not waypoints:
            raise InvalidInput("a camera path needs at least one camera")
        times = [each.time_s for each in waypoints]
        for before, after in pairwise(times):
            if not before < after:
                raise InvalidInput(f"the times of a camera path must increase; {after:g} s comes after {before:g} s")
        if len({each.intrinsics is None for each in waypoints}) > 1:
            raise InvalidInput("a camera path has intrinsics with every camera or with none")
        self._waypoints, self._times = waypoints, times

    @property
    def window_s(self) -> tuple[float, float]:
        """First and last time in seconds."""
        return self._times[0], self._times[-1]

    def camera(self, start: Camera, time_s: float) -> Camera:
        """Return the camera `start` at the path's pose at `time_s`, with the path's intrinsics if it has any; times are clamped."""
        k = min(max(bisect_right(self._times, time_s) - 1, 0), len(self._times) - 1)
        before, after = self._waypoints[k], self._waypoints[min(k + 1, len(self._times) - 1)]
        span = after.time_s - before.time_s
        share = min(max((time_s - before.time_s) / span, 0.0), 1.0) if span > 0 else 0.0
        pose = np.eye(4)
        pose[:3, :3] = _turned(before.camera_to_world[:3, :3], after.camera_to_world[:3, :3], share)
        pose[:3, 3] = (1 - share) * before.camera_to_world[:3, 3] + share * after.camera_to_world[:3, 3]
        camera = start.with_pose(_inverse(pose))
        if before.intrinsics is None or after.intrinsics is None:
            return camera
        fx, fy, cx, cy = (1 - share) * _intrinsics(before, start) + share * _intrinsics(after, start)
        return replace(camera, K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))


def read_camera_path(path: Path) -> CameraPath:
    """Read a camera path from a JSON file.

    Raises:
        InvalidSetting: if the file cannot be read or is invalid; the message names the location.
    """
    try:
        text = read_regular(path, MOST_BYTES)
    except OSError as error:
        raise InvalidSetting(f"cannot read the camera path {path}: {error.strerror or error}") from error
    try:
        if text.lstrip()[:1] == b"[":
            return _inria_path(text, path.name)
        listed = JsonObject.parse(text, path.name).values.get("cameras")
        if not isinstance(listed, list) or not 1 <= len(listed) <= MOST_CAMERAS:
            raise InvalidInput(f"{path.name}: cameras must be a list of 1 to {MOST_CAMERAS} objects")
        return CameraPath([_waypoint(JsonObject(each, f"{path.name}: cameras[{k}]")) for k, each in enumerate(listed)])
    except (BundleCorrupt, InvalidInput) as error:
        raise InvalidSetting(f"the camera path cannot be used: {error}") from error


def _intrinsics(waypoint: Waypoint, camera: Camera) -> NDArray[np.float64]:
    """Return fx, fy, cx and cy of a waypoint in pixels of the camera. Intrinsics of another picture height are scaled to the
    camera's height, with the principal point in the middle.
    """
    fx, fy, cx, cy = waypoint.intrinsics or ()
    if waypoint.height_px is None:
        return np.array([fx, fy, cx, cy])
    factor = camera.height_px / waypoint.height_px
    return np.array([fx * factor, fy * factor, camera.width_px / 2, camera.height_px / 2])


def _inria_path(text: bytes, name: str) -> CameraPath:
    listed = JsonObject.parse(b'{"cameras": ' + text + b"}", name).values["cameras"]
    if not 1 <= len(listed) <= MOST_CAMERAS:
        raise InvalidInput(f"{name} must have 1 to {MOST_CAMERAS} cameras, not {len(listed)}")
    waypoints = []
    for k, each in enumerate(listed):
        reader = JsonObject(each, f"{name}: [{k}]")
        pose = np.eye(4)
        position = reader.numbers("position", PLACE, 3)
        if len(position) != 3:
            raise InvalidInput(f"{reader.name}: position must be three numbers, got {position}")
        pose[:3, :3], pose[:3, 3] = reader.matrix("rotation", 3, PLACE), position
        _check_rotation(reader.name, "rotation", pose)
        fx, fy = reader.number("fx", FOCAL_PX), reader.number("fy", FOCAL_PX)
        waypoints.append(Waypoint(float(k), pose, (fx, fy, 0.0, 0.0), reader.integer("height", HEIGHT_PX)))
    return CameraPath(waypoints)


def _check_rotation(name: str, key: str, pose: NDArray[np.float64]) -> None:
    rotation = pose[:3, :3]
    off = float(np.abs(np.clip(rotation, -2, 2) @ np.clip(rotation, -2, 2).T - np.eye(3)).max())
    if pose[3].tolist() != [0, 0, 0, 1]:
        why = f"its last row is {' '.join(f'{value:g}' for value in pose[3])}"
    elif off > ROTATION_TOLERANCE:
        why = f"its rotation is off by {off:.3g}"
    elif np.linalg.det(rotation) < 0:
        why = "it mirrors"
    else:
        return
    raise InvalidInput(f"{name}: {key} must be a rotation and a translation, with 0 0 0 1 as its last row; {why}")


def _waypoint(reader: JsonObject) -> Waypoint:
    pose = np.array(reader.matrix("camera_to_world", 4, PLACE))
    _check_rotation(reader.name, "camera_to_world", pose)
    intrinsics = None
    if reader.values.get("intrinsics") is not None:
        nested = reader.nested("intrinsics")
        intrinsics = tuple(nested.number(name, wanted) for name, wanted in INTRINSICS.items())
    return Waypoint(reader.number("time_s", TIME_S), pose, intrinsics)


def _inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def _turned(first: NDArray[np.float64], second: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Interpolate between two rotations [3, 3] by `share` along the geodesic (Rodrigues' formula)."""
    import cv2  # imported only here, because most processes do not use a camera path

    between, _ = cv2.Rodrigues(first.T @ second)
    part, _ = cv2.Rodrigues(share * between)
    # Orthonormalise the product again, because rounded rotations are not exactly orthogonal.
    u, _, v = np.linalg.svd(first @ part)
    return np.asarray(u @ v)
