"""Constant-size score accumulators of the protocols, and reasons for excluding frames."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import MEASURES, FrameQuality, ImageLike, QualityTracker, frame_quality

Entry = dict[str, float | int | bool | str | None]
"""Measures of one frame by name; None for a measure that the frame does not have."""
Record = Callable[[Entry], None]
"""Callback that receives each frame's measures in order."""


@dataclass(frozen=True)
class Score:
    """Image quality of the frames of one protocol, averaged over frames.

    PSNR is averaged in decibels. A measure is None if no frame has it.
    """

    psnr_tissue_db: float | None
    psnr_frame_db: float | None
    ssim: float | None
    frames: int
    """Number of scored frames."""
    worst_db: float | None
    """Lowest tissue PSNR of any frame, in dB."""
    worst_seq: int | None
    """Sequence number of the frame with the lowest tissue PSNR."""
    left_out: Mapping[str, int]
    """Numbers of excluded frames by reason."""


def why_left_out(frame: Frame) -> str | None:
    """Return the reason to exclude a frame from scoring, or None to score it.

    Damaged frames contain guesses of the decoder. Withheld frames are blurred, smoky or outside the
    body. Frames without tissue pixels offer nothing to compare.
    """
    if frame.status is FrameStatus.DAMAGED:
        return "damaged"
    if frame.withheld is not None:
        return "withheld"
    if frame.mask is not None and not frame.mask.any():
        return "no tissue"
    return None


class ScoreSums:
    """Streaming accumulator of frame scores; the result is `score`."""

    def __init__(self) -> None:
        self._quality = QualityTracker()
        self._left_out: Counter[str] = Counter()
        self._worst = math.inf
        self._worst_seq: int | None = None

    def add(self, frame: Frame, picture: ImageLike) -> FrameQuality:
        """Compare a picture with its frame and add the result.

        Args:
            frame: reference frame.
            picture: [H, W, 3], uint8 or float in 0..1.

        Raises:
            InvalidInput: if the sizes differ.
        """
        quality = frame_quality(frame.seq, picture, frame.image, frame.mask)
        self.take(quality)
        return quality

    def take(self, quality: FrameQuality) -> None:
        """Add measures computed elsewhere; non-finite values count as missing."""
        self._quality.take(quality)
        if quality.psnr_tissue_db < self._worst:
            self._worst, self._worst_seq = quality.psnr_tissue_db, quality.seq

    def leave_out(self, reason: str) -> None:
        """Count an excluded frame."""
        self._left_out[reason] += 1

    @property
    def score(self) -> Score:
        """Mean scores of all frames so far."""
        worst = None if self._worst_seq is None else self._worst
        means = self._quality.means()
        return Score(
            **means,
            frames=self._quality.count,
            worst_db=worst,
            worst_seq=self._worst_seq,
            left_out=dict(sorted(self._left_out.items())),
        )


def measures(quality: FrameQuality) -> Entry:
    """Return the measures of a frame by name, for a log."""
    return {name: finite(getattr(quality, name)) for name in MEASURES}


def finite(value: float | None) -> float | None:
    """Return the value, or None if it is not a finite number."""
    return value if value is not None and math.isfinite(value) else None


def number(entry: Entry, name: str) -> float | None:
    """Return a named figure of an entry, or None if missing."""
    value = entry.get(name)
    return None if value is None or isinstance(value, str) else float(value)
