"""Ranges of the options that several applications take."""

from __future__ import annotations

import math

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera

MAX_SEED = 2**63 - 1
"""What every generator of random numbers here takes."""
MAX_SCALE = 64.0
MAX_PIXELS = 64 * 2**20
"""Of one picture (8192x8192); surgical video has 8 million at most."""
MAX_SIDE_PX = 2**15
"""Of one picture; two stand side by side in a video, and video formats count to 65535."""
MAX_STEPS = 100_000_000
MAX_FRAMES = 10**9
LEAST_FPS = 0.001
"""A video's file cannot state a rate that is much lower."""
MAX_RENDERED_FRAMES = 1_000_000
"""Of one `render`: nine hours at 30 frames a second."""


def check_seed(seed: int) -> None:
    """Raises InvalidSetting for a seed that not every generator takes."""
    if not 0 <= seed <= MAX_SEED:
        raise InvalidSetting(f"seed is {seed}; it must be from 0 to {MAX_SEED}")


def check_steps(name: str, steps: int) -> None:
    """Raises InvalidSetting for a number of training steps, called `name`, that is out of range."""
    if not 1 <= steps <= MAX_STEPS:
        raise InvalidSetting(f"{name} is {steps}; it must be from 1 to {MAX_STEPS}")


def check_max_frames(max_frames: int | None) -> None:
    """Raises InvalidSetting for a number of frames that is out of range; None is all of them."""
    if max_frames is None:
        return
    if max_frames < 1:
        raise InvalidSetting(f"max_frames must be at least 1, got {max_frames}")
    if max_frames > MAX_FRAMES:
        raise InvalidSetting(f"max_frames must be at most {MAX_FRAMES}, got {max_frames}")


def check_scale(scale: float) -> None:
    """Raises InvalidSetting for a scale that is not positive or too large for any picture."""
    if not 0 < scale < math.inf:
        raise InvalidSetting(f"scale must be a positive number, got {scale:g}")
    if scale > MAX_SCALE:
        raise InvalidSetting(f"scale must be at most {MAX_SCALE:g}, got {scale:g}")


def check_picture(camera: Camera, scale: float) -> None:
    """Raises InvalidSetting when pictures of `camera`, which has been scaled already, are larger than this program makes."""
    width_px, height_px = camera.width_px, camera.height_px
    if max(width_px, height_px) > MAX_SIDE_PX or width_px * height_px > MAX_PIXELS:
        raise InvalidSetting(
            f"at scale {scale:g} a picture has {width_px}x{height_px} px; at most {MAX_PIXELS // 2**20} million and {MAX_SIDE_PX} on a side"
            " are possible: give a smaller --scale"
        )


def check_shown_size(width_px: float, height_px: float, scale: float) -> None:
    """Raise InvalidSetting for a scale that leaves less than one pixel of a side."""
    if min(width_px, height_px) * scale < 1:
        raise InvalidSetting(
            f"at scale {scale:g} nothing is left of {width_px:g}x{height_px:g} px; give at least {1 / min(width_px, height_px):.3g}"
        )


def check_width(width_px: int) -> None:
    """Raises InvalidSetting when pictures side by side are wider than this program makes."""
    if width_px > MAX_SIDE_PX:
        raise InvalidSetting(
            f"the pictures side by side are {width_px} px wide; at most {MAX_SIDE_PX}: give a smaller --scale"
        )


def frames_to_render(window_s: tuple[float, float], fps: float) -> int:
    """How many frames show a time window from end to end. Raises InvalidSetting for a rate that is out of range, and for too many frames."""
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
