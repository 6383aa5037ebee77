"""What an application reports about its progress while it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """One step of progress."""

    stage: str
    """What is being done, in a word."""
    done: int
    total: int
    unit: str = "frames"
    psnr_tissue_db: float | None = None
    """Tissue PSNR of the newest displayed frame; its training error where `trained`."""
    previous_frame_db: float | None = None
    """Tissue PSNR of the raw frame before it, shown instead."""
    next_frame_db: float | None = None
    """Tissue PSNR of the next frame, predicted before it was trained on: no training error."""
    trained: bool = True
    """The newest displayed frame was trained on before it was shown."""


ProgressCallback = Callable[[Progress], None]
