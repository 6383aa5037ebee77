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
    """Quality of the newest displayed frame."""


ProgressCallback = Callable[[Progress], None]
