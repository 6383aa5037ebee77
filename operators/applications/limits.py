"""Limits on pictures and rendered frames. `operators.settings` declares the ranges of options."""

from __future__ import annotations

import math

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera

MAX_PIXELS = 64 * 2**20
"""Maximum number of pixels of a picture (8192x8192). Surgical video has at most 8 million."""
MAX_SIDE_PX = 2**15
"""Maximum side of a picture. Videos show two side by side, and video formats are limited to
65535.
"""
LEAST_FPS = 0.001
"""Minimum frame rate; video containers cannot store much lower rates."""
MAX_RENDERED_FRAMES = 1_000_000
"""Maximum number of frames of one `render`: nine hours at 30 frames/s."""


def check_picture(camera: Camera, scale: float) -> None:
    """Raise InvalidSetting if the pictures of an already scaled camera are too large."""
    width_px, height_px = camera.width_px, camera.height_px
    if max(width_px, height_px) > MAX_SIDE_PX or width_px * height_px > MAX_PIXELS:
        raise InvalidSetting(
            f"at scale {scale:g} a picture has {width_px}x{height_px} px; at most {MAX_PIXELS // 2**20} million and {MAX_SIDE_PX} on a side"
            " are possible: give a smaller --scale"
        )


def check_shown_size(width_px: float, height_px: float, scale: float) -> None:
    """Raise InvalidSetting for a scale at which a side has less than one pixel."""
    if min(width_px, height_px) * scale < 1:
        raise InvalidSetting(
            f"at scale {scale:g} nothing is left of {width_px:g}x{height_px:g} px; give at least {1 / min(width_px, height_px):.3g}"
        )


def check_width(width_px: int) -> None:
    """Raise InvalidSetting if pictures side by side are wider than `MAX_SIDE_PX`."""
    if width_px > MAX_SIDE_PX:
        raise InvalidSetting(
            f"the pictures side by side are {width_px} px wide; at most {MAX_SIDE_PX}: give a smaller --scale"
        )


def frames_to_render(window_s: tuple[float, float], fps: float) -> int:
    """Return the number of frames that cover a time window.

    Args:
        window_s: start and end, in seconds.
        fps: frame rate in frames/s.

    Raises:
        InvalidSetting: the rate is out of range, or there are too many frames.
    """
    if not (math.isfinite(fps) and LEAST_FPS <= fps <= 1000):
        raise InvalidSetting(f"fps is {fps:g}; it must be at least {LEAST_FPS:g} and at most 1000")
    start_s, end_s = window_s
    span = (end_s - start_s) * fps
    if not span < MAX_RENDERED_FRAMES:
        raise InvalidSetting(
            f"the model's time from {start_s:g} to {end_s:g} s is {span:.3g} frames at fps {fps:g}; at most {MAX_RENDERED_FRAMES} are"
            " rendered: give a smaller --fps"
        )
    return math.floor(span + 1e-6) + 1
