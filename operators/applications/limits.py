"""Ranges of options that several applications share."""

from __future__ import annotations

import math

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera

MAX_SEED = 2**63 - 1
"""Largest seed that all random generators accept."""
MAX_SCALE = 64.0
MAX_PIXELS = 64 * 2**20
"""Maximum number of pixels of a picture (8192x8192). Surgical video has at most 8 million."""
MAX_SIDE_PX = 2**15
"""Maximum side of a picture. Videos show two side by side, and video formats are limited to
65535.
"""
MAX_STEPS = 100_000_000
MAX_FRAMES = 10**9
LEAST_FPS = 0.001
"""Minimum frame rate; video containers cannot store much lower rates."""
MAX_RENDERED_FRAMES = 1_000_000
"""Maximum number of frames of one `render`: nine hours at 30 frames/s."""


def check_seed(seed: int) -> None:
    """Raise InvalidSetting for a seed that some random generator does not accept."""
    if not 0 <= seed <= MAX_SEED:
        raise InvalidSetting(f"seed is {seed}; it must be from 0 to {MAX_SEED}")


def check_steps(name: str, steps: int) -> None:
    """Raise InvalidSetting for a number of training steps out of range; `name` is the option's
    name.
    """
    if not 1 <= steps <= MAX_STEPS:
        raise InvalidSetting(f"{name} is {steps}; it must be from 1 to {MAX_STEPS}")


def check_max_frames(max_frames: int | None) -> None:
    """Raise InvalidSetting for a number of frames out of range; None means all frames."""
    if max_frames is None:
        return
    if max_frames < 1:
        raise InvalidSetting(f"max_frames must be at least 1, got {max_frames}")
    if max_frames > MAX_FRAMES:
        raise InvalidSetting(f"max_frames must be at most {MAX_FRAMES}, got {max_frames}")


def check_scale(scale: float) -> None:
    """Raise InvalidSetting for a scale that is not positive or above `MAX_SCALE`."""
    if not 0 < scale < math.inf:
        raise InvalidSetting(f"scale must be a positive number, got {scale:g}")
    if scale > MAX_SCALE:
        raise InvalidSetting(f"scale must be at most {MAX_SCALE:g}, got {scale:g}")


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
