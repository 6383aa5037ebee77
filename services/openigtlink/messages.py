"""OpenIGTLink messages of a stream: picture, camera pose, and state."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting

MOST_NAME = 20
"""Longest device name in the protocol."""
_LONGEST_ENDING = "_Camera"


def pyigtl() -> Any:
    """Import pyigtl.

    Raises:
        InvalidSetting: if it is not installed.
    """
    try:
        import pyigtl as library
    except ImportError:
        raise InvalidSetting("OpenIGTLink needs pyigtl; install it with: pip install 'intrasplat[igtl]'") from None
    return library


class StreamMessages:
    """Packer of one stream's messages.

    Picture axes: i right, j down, k = 0, with three components (red, green, blue). A voxel is
    `spacing_mm` wide and high, and the origin is the picture's centre. Camera coordinates (x right,
    y down, z forward) are sent as RAS, so receivers change no sign. The patient's left and right
    are unknown.

    Raises:
        InvalidSetting: if the name or the spacing is not valid.
    """

    def __init__(self, name: str, spacing_mm: float = 1.0) -> None:
        if not 1 <= len(name) <= MOST_NAME - len(_LONGEST_ENDING) or not name.isascii() or not name.isprintable():
            raise InvalidSetting(
                f"{name!r:.60} cannot be a device's name; take 1 to {MOST_NAME - len(_LONGEST_ENDING)} printable ASCII characters"
            )
        if not 1e-6 <= spacing_mm <= 1e6:
            raise InvalidSetting(f"the spacing is {spacing_mm:g} mm; it must be positive, from 1e-6 to 1e6")
        self._library = pyigtl()
        self._name, self._spacing_mm = name, spacing_mm

    def packed(self, header: Mapping[str, Any], image: NDArray[np.uint8]) -> bytes:
        """Pack IMAGE, TRANSFORM and STRING of a picture, RGB uint8 [H, W, 3], in this order."""
        at_s = taken_at(header)
        place = ijk_to_camera(image.shape[1], image.shape[0], self._spacing_mm)
        picture = self._library.ImageMessage(
            np.ascontiguousarray(image)[None], place, "ras", timestamp=at_s, device_name=self._name
        )
        pose = np.linalg.inv(np.asarray(header.get("world_to_camera") or np.eye(4), np.float64))
        camera = self._library.TransformMessage(pose, timestamp=at_s, device_name=f"{self._name}_Camera")
        said = f"{header.get('state', 'live')} {header.get('age_ms', 0):.0f} ms"
        return picture.pack() + camera.pack() + self.state(said, at_s)

    def state(self, said: str, at_s: float | None = None) -> bytes:
        """Pack a STRING with the state of the picture."""
        message: bytes = self._library.StringMessage(
            said, timestamp=at_s or time.time(), device_name=f"{self._name}_State"
        ).pack()
        return message


def ijk_to_camera(width_px: int, height_px: int, spacing_mm: float) -> NDArray[np.float64]:
    """Return the 4x4 matrix from voxel indices to camera coordinates, with the origin at the
    picture's centre."""
    place = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    place[:2, 3] = -0.5 * spacing_mm * np.array([width_px - 1, height_px - 1])
    return place


def taken_at(header: Mapping[str, Any]) -> float:
    """Return the arrival time of a picture's newest frame as Unix time in seconds."""
    arrived_ns = header.get("arrived_ns")
    since_s = (time.monotonic_ns() - arrived_ns) * 1e-9 if isinstance(arrived_ns, int) else 0.0
    return time.time() - since_s
