"""Limits on pictures, rendered frames and memory, to refuse a run that cannot fit before it starts.

`operators.settings` declares the ranges of options. The constants of the memory estimates are fitted to the peak
resident size of replays on a CPU: two recordings (540x540 and 640x512 pixels) at scales 0.5, 1 and 2, with 2 to 156
frames. Including the 0.5 GiB that the process uses before its first frame, the estimates are within 10 % of each
measurement.
"""

from __future__ import annotations

import math

from gsplat_core.choices import FIELDS
from gsplat_core.deformation.kinds import PARAMETER_BYTES
from gsplat_core.errors import InvalidSetting
from gsplat_core.machine import available_bytes
from gsplat_core.scene.cameras import Camera
from gsplat_core.training.config import ReconstructorConfig
from operators.errors import MemoryTooSmall
from operators.sources.source import SourceDescription
from operators.storage import mebibytes

MAX_PIXELS = 64 * 2**20
"""Maximum number of pixels of a picture (8192x8192). Surgical video has at most 8 million."""
MAX_SIDE_PX = 2**15
"""Maximum side of a picture. Videos show two side by side, and video formats are limited to 65535."""
LEAST_FPS = 0.001
"""Minimum frame rate; video containers cannot store much lower rates."""
MAX_RENDERED_FRAMES = 1_000_000
"""Maximum number of frames of one `render`: nine hours at 30 frames/s."""


def check_picture(camera: Camera, scale: float) -> None:
    """Raise InvalidSetting if the pictures of `camera`, which is already scaled by `scale`, are too large."""
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


FIXED_BYTES = 16 * 2**20
"""Memory of threads, the video encoder and the report, in bytes."""
PIXEL_BYTES = 200
"""Bytes per pixel for training, scoring and the report's pictures."""
WINDOW_PIXEL_BYTES = 26
"""Bytes per pixel of each frame kept for training."""
_CANONICAL = 14
RENDER_PIXEL_BYTES = 60
RENDER_PARAMETER_BYTES = 12


def replay_bytes(source: SourceDescription, config: ReconstructorConfig, *, offline: bool = False) -> int:
    """Estimate the memory of a replay in bytes.

    Args:
        source: description of the recording.
        config: settings of the reconstructor.
        offline: offline reconstruction, which keeps every frame.
    """
    frames = source.frame_count or config.window_frames
    kept = frames if offline else min(frames, config.window_frames)
    pixels = source.width_px * source.height_px
    # Offline training uses the full capacity. Online training adds Gaussians only for new tissue, of which a static
    # endoscope shows little.
    gaussians = config.max_gaussians if offline else config.gaussians
    field = FIELDS[config.field].training_bytes(gaussians, frames / source.fps / config.motion_spacing_s)
    model = PARAMETER_BYTES * gaussians * _CANONICAL + field
    return FIXED_BYTES + pixels * (PIXEL_BYTES + WINDOW_PIXEL_BYTES * kept) + model


def render_bytes(width_px: int, height_px: int, parameters: int) -> int:
    """Estimate the memory in bytes for rendering pictures of this size from a loaded model with `parameters` tensor values."""
    return FIXED_BYTES + width_px * height_px * RENDER_PIXEL_BYTES + RENDER_PARAMETER_BYTES * parameters


def require_memory(needed: int, what: str, advice: str) -> None:
    """Raise MemoryTooSmall if less than `needed` bytes are available.

    Args:
        needed: required memory in bytes.
        what: subject of the error message.
        advice: remedy, for the error message.
    """
    available = available_bytes()
    if available is not None and needed > available:
        raise MemoryTooSmall(
            f"{what} takes about {mebibytes(needed)} of memory, and {mebibytes(available)} are free; {advice}"
        )
