"""Memory estimates, to refuse a run that cannot fit before it starts.

The constants are fitted to the peak resident size of replays on a CPU: `sinus` (540x540) and
`cutting` (640x512) at scales 0.5, 1 and 2, with 2 to 156 frames. Including the 0.5 GiB that the
process uses before its first frame, the estimates are within 10 % of each measurement.
"""

from __future__ import annotations

from gsplat_core.memory import available_bytes
from gsplat_core.training.config import ReconstructorConfig
from operators.errors import MemoryTooSmall
from operators.sources.source import SourceDescription
from operators.storage import mebibytes

FIXED_BYTES = 16 * 2**20
"""Memory of threads, the video encoder and the report."""
OTHER_FIELD_BYTES = 256 * 2**20
"""Memory of a field without basis functions, including training: HexPlane, measured with 30,000
Gaussians.
"""
PIXEL_BYTES = 200
"""Bytes per pixel for training, scoring and the report's pictures."""
WINDOW_PIXEL_BYTES = 26
"""Bytes per pixel of each frame kept for training."""
PARAMETER_BYTES = 32
"""Bytes per model parameter: the value, Adam's two moments, snapshots and the copy for saving."""
_CANONICAL = 14
_BUMP = 15
_BUMPS_AT_START = 5
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
    # A field of basis functions grows with the duration of the stream.
    basis = config.chosen_field == "basis"
    bumps = _BUMPS_AT_START + round(frames / source.fps / config.bump_spacing_s) if basis else 0
    # Offline training ends with all Gaussians. Online, Gaussians are added for new tissue, of which
    # a fixed scope shows little.
    gaussians = config.max_gaussians if offline else config.gaussians
    model = PARAMETER_BYTES * gaussians * (_CANONICAL + _BUMP * bumps)
    return (
        FIXED_BYTES + (0 if basis else OTHER_FIELD_BYTES) + pixels * (PIXEL_BYTES + WINDOW_PIXEL_BYTES * kept) + model
    )


def render_bytes(width_px: int, height_px: int, parameters: int) -> int:
    """Estimate the memory in bytes for rendering pictures of this size from a loaded model of
    `parameters` values.
    """
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
