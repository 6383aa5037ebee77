"""How much memory a run takes, so that one that cannot fit is refused before it starts.

Rules of thumb, fitted to the peak resident size of replays on a CPU: `sinus` (540x540) and `cutting` (640x512) at scales 0.5, 1 and 2, 2 to
156 frames. Together with what the process takes before its first frame (0.5 GiB) they are within 10 % of each.
"""

from __future__ import annotations

from gsplat_core.memory import available_bytes
from gsplat_core.training.config import ReconstructorConfig
from operators.errors import MemoryTooSmall
from operators.sources.source import SourceDescription
from operators.storage import mebibytes

FIXED_BYTES = 16 * 2**20
"""Threads, the video's encoder, the report."""
OTHER_FIELD_BYTES = 256 * 2**20
"""A field that is not made of basis functions, with what its training needs: HexPlane, measured with 30,000 Gaussians."""
PIXEL_BYTES = 200
"""For each pixel of a frame: training, scoring, the pictures of the report."""
WINDOW_PIXEL_BYTES = 26
"""For each pixel of every frame that is kept for training."""
PARAMETER_BYTES = 32
"""For each number of the model: itself, Adam's two moments, snapshots and what is being saved."""
_CANONICAL = 14
_BUMP = 15
_BUMPS_AT_START = 5
RENDER_PIXEL_BYTES = 60
RENDER_PARAMETER_BYTES = 12


def replay_bytes(source: SourceDescription, config: ReconstructorConfig, *, offline: bool = False) -> int:
    """What a replay of the source takes, or an offline reconstruction, which keeps every frame."""
    frames = source.frame_count or config.window_frames
    kept = frames if offline else min(frames, config.window_frames)
    pixels = source.width_px * source.height_px
    # A field of basis functions grows with the stream.
    basis = config.chosen_field == "basis"
    bumps = _BUMPS_AT_START + round(frames / source.fps / config.bump_spacing_s) if basis else 0
    # Offline every Gaussian is there in the end; online they come where tissue appears, on a fixed scope hardly any.
    gaussians = config.max_gaussians if offline else config.gaussians
    model = PARAMETER_BYTES * gaussians * (_CANONICAL + _BUMP * bumps)
    return (
        FIXED_BYTES + (0 if basis else OTHER_FIELD_BYTES) + pixels * (PIXEL_BYTES + WINDOW_PIXEL_BYTES * kept) + model
    )


def render_bytes(width_px: int, height_px: int, parameters: int) -> int:
    """What rendering pictures of this size takes, from a model of so many numbers that has been loaded."""
    return FIXED_BYTES + width_px * height_px * RENDER_PIXEL_BYTES + RENDER_PARAMETER_BYTES * parameters


def require_memory(needed: int, what: str, advice: str) -> None:
    """Raises MemoryTooSmall when this machine, or the limits of this process, cannot give so many bytes."""
    available = available_bytes()
    if available is not None and needed > available:
        raise MemoryTooSmall(
            f"{what} takes about {mebibytes(needed)} of memory, and {mebibytes(available)} are free; {advice}"
        )
