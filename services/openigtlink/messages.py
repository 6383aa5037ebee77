"""OpenIGTLink messages of a stream: the picture, the pose of its camera, and what it is worth."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting

MOST_NAME = 20
"""What a device name may have in the protocol."""
_LONGEST_ENDING = "_Camera"


def pyigtl() -> Any:
    """The library that packs messages. Raises InvalidSetting where it is not installed."""
    try:
        import pyigtl as library
    except ImportError:
        raise InvalidSetting("OpenIGTLink needs pyigtl; install it with: pip install 'intrasplat[igtl]'") from None
    return library


class StreamMessages:
    """Packs the messages of one stream. Raises InvalidSetting for a name or a spacing that cannot be.

    The picture's axes: i to the right, j down, as they are in the picture, k = 0; three components, red, green, blue. One voxel is `spacing_mm` wide and
    high, and the middle of the picture is the origin. The coordinates are those of the camera (x right, y down, z forward) and are sent as RAS, so
    that a receiver changes no sign: what is right or left of the patient is not known here.
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
        """IMAGE, TRANSFORM and STRING of a picture, RGB uint8 [H, W, 3], one after another."""
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
        """A STRING that says what the picture is worth."""
        message: bytes = self._library.StringMessage(
            said, timestamp=at_s or time.time(), device_name=f"{self._name}_State"
        ).pack()
        return message


def ijk_to_camera(width_px: int, height_px: int, spacing_mm: float) -> NDArray[np.float64]:
    """From voxel indices to camera coordinates, the middle of the picture at the origin."""
    place = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    place[:2, 3] = -0.5 * spacing_mm * np.array([width_px - 1, height_px - 1])
    return place


def taken_at(header: Mapping[str, Any]) -> float:
    """When the newest frame of a picture came in, in seconds since 1970."""
    arrived_ns = header.get("arrived_ns")
    since_s = (time.monotonic_ns() - arrived_ns) * 1e-9 if isinstance(arrived_ns, int) else 0.0
    return time.time() - since_s
