"""What doing nothing scores: the trivial baselines that every table of reconstruction quality needs beside it.

A copy of the previous frame is a strong baseline in slow endoscopy; a reconstruction that scores below it shows nothing that a frozen
video would not. Two passes over the recording, three frames and one sum in memory, however long the recording. Frames are held out by
their number, `Frame.seq`; where numbers are missing, "the frame before" is the one that came before.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings.split import is_heldout
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.metrics import ScoredMean, psnr_tissue_db


@dataclass(frozen=True)
class Baselines:
    """Mean tissue PSNR in dB of each baseline, against the tissue pixels of the frame being scored; None where no frame has one."""

    previous_frame_db: float | None
    """Frame i-1 shown for frame i, over all frames from the second on: the comparison for live quality."""
    heldout_previous_frame_db: float | None
    """Frame i-1 shown for held-out frame i."""
    heldout_neighbour_mean_db: float | None
    """Mean of frames i-1 and i+1 shown for held-out frame i. It sees the future, which a live system cannot."""
    heldout_train_mean_db: float | None
    """Mean of all training frames (tools and all, as the field computes it) shown for every held-out frame."""


def measure_baselines(recording: Iterable[Frame]) -> Baselines:
    """Score the trivial baselines on a recording; reads it twice.

    Args:
        recording: anything that gives the frames in order each time it is iterated. Frames need not have a mask.

    Raises:
        InvalidInput: the recording can be iterated only once, or its frames differ in size.
    """
    if isinstance(recording, Iterator):
        raise InvalidInput(
            "measure_baselines reads the frames twice: pass the recording itself, not an iterator over it"
        )
    previous = ScoredMean()
    heldout_previous = ScoredMean()
    heldout_neighbours = ScoredMean()
    train_mean = _TrainMean()
    before: Frame | None = None
    pending: tuple[Frame, Frame] | None = None  # a held-out frame and the one before it, waiting for the one after
    for frame in recording:
        if before is not None and before.image.shape != frame.image.shape:
            raise InvalidInput(
                f"frame {frame.seq} is {list(frame.image.shape)}, the one before it {list(before.image.shape)}; they must be equal"
            )
        if pending is not None:
            heldout, earlier = pending
            middle = (earlier.image.astype(np.float32) + frame.image) / np.float32(2 * 255)
            heldout_neighbours.add(psnr_tissue_db(middle, heldout.image, heldout.mask))
            pending = None
        if before is not None:
            value = psnr_tissue_db(before.image, frame.image, frame.mask)
            previous.add(value)
            if is_heldout(frame.seq):
                heldout_previous.add(value)
                pending = frame, before
        if not is_heldout(frame.seq) and frame.status is not FrameStatus.DAMAGED:
            train_mean.add(frame.image)
        before = frame
    mean_image = train_mean.image()
    heldout_train_mean = ScoredMean()
    for frame in recording:
        if mean_image is not None and is_heldout(frame.seq):
            heldout_train_mean.add(psnr_tissue_db(mean_image, frame.image, frame.mask))
    return Baselines(
        previous_frame_db=previous.mean,
        heldout_previous_frame_db=heldout_previous.mean,
        heldout_neighbour_mean_db=heldout_neighbours.mean,
        heldout_train_mean_db=heldout_train_mean.mean,
    )


class _TrainMean:
    """Running mean of images, exact in integers: 2^24 frames fit."""

    def __init__(self) -> None:
        self._sum: NDArray[np.uint32] | None = None
        self._count = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        if self._sum is None:
            self._sum = np.zeros(image.shape, np.uint32)
        self._sum += image
        self._count += 1

    def image(self) -> NDArray[np.float32] | None:
        """The mean in 0..1; None without any image."""
        if self._sum is None:
            return None
        return (self._sum / (255.0 * self._count)).astype(np.float32)
