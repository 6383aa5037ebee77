"""Progress reports of a running application."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """Report of a running application: how far its current stage is, with the newest frame's scores (None if not
    scored).
    """

    stage: str
    """Name of the current stage as one word, such as "train"."""
    done: int
    total: int
    unit: str = "frames"
    psnr_tissue_db: float | None = None
    """Tissue PSNR of the newest displayed frame in dB; its training error if `trained`."""
    previous_frame_db: float | None = None
    """Tissue PSNR in dB of the previous raw frame (trivial baseline)."""
    next_frame_db: float | None = None
    """Tissue PSNR in dB of the frame's prediction before training on it."""
    trained: bool = True
    """True if the newest displayed frame was trained on before display."""


ProgressCallback = Callable[[Progress], None]
