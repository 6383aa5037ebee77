"""Local cameras and capture cards through Video4Linux."""

from __future__ import annotations

import os
import re
import stat

from gsplat_core.errors import InvalidSetting
from operators.errors import SourceUnavailable
from operators.sources.address import SourceOptions, V4l2Address
from operators.sources.url import ConnectedSource, Place

_DEVICE = re.compile(r"/dev/video\d{1,4}")
READ_S = 5.0


def v4l2_source(rest: str, options: SourceOptions) -> ConnectedSource:
    """Open `v4l2:/dev/video0?size=1920x1080&fps=60&format=mjpeg`; omitted options keep the driver's settings.

    The source reconnects to a camera that was unplugged. Raises InvalidSetting, and SourceUnavailable if the device
    does not exist.
    """
    address = V4l2Address.parse(rest, options)
    size, fps, name = address.size, address.fps, address.format
    asked = {
        "video_size": None if size is None else f"{size[0]}x{size[1]}",
        "framerate": None if fps is None else f"{fps:g}",
        "input_format": None if name == "auto" else name,
    }
    device = device_of(address.place)
    place = Place(
        device, {option: value for option, value in asked.items() if value is not None}, "v4l2", read_s=READ_S
    )
    return ConnectedSource(place, f"camera {device}", options)


def device_of(path: str) -> str:
    """Return the device path of a camera: `path` itself, such as `/dev/video0`, or the target of a link in
    `/dev/v4l/by-id/`. Raises InvalidSetting and SourceUnavailable."""
    device = os.path.realpath(path) if path.startswith("/dev/") and "\0" not in path else path
    # Opening a device can have side effects, so only camera devices are accepted.
    if not _DEVICE.fullmatch(device):
        raise InvalidSetting(f"v4l2: {path!r:.200} is no camera; give /dev/video0, or a link to one in /dev/v4l/by-id")
    try:
        mode = os.stat(device).st_mode
    except OSError as error:
        raise SourceUnavailable(
            f"there is no camera {device} ({error.strerror}). Plug it in, and look at /dev/video*."
        ) from error
    if not stat.S_ISCHR(mode):
        raise SourceUnavailable(f"{device} is no camera: it is no device.")
    return device
