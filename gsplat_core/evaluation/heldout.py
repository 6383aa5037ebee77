"""The field's held-out protocol on a finished model: frames that training never saw, rendered at their times and poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from gsplat_core.evaluation.depth import DepthErrors, DepthSums
from gsplat_core.evaluation.pictures import Picture
from gsplat_core.evaluation.scores import Record, Score, ScoreSums, finite, measures, why_left_out
from gsplat_core.io.recordings.split import is_heldout
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import ScoredMean, psnr_tissue_db

OUTSIDE = "outside of the model's time"


@dataclass(frozen=True)
class HeldOut:
    """What a model scores on the held-out frames."""

    score: Score
    """Of the pictures as displayed, rounded to 8 bits: what EndoGaussian measures after it has written PNG files."""
    unrounded_db: float | None
    """Mean tissue PSNR of the pictures before they are rounded."""
    depth: DepthErrors | None
    """None where the recording has no depth."""


def evaluate_heldout(
    frames: Iterable[Frame],
    picture_of: Callable[[Frame], Picture],
    *,
    window_s: tuple[float, float],
    record: Record | None = None,
) -> HeldOut:
    """Score the frames with (i - 1) mod 8 = 0, counted from 0 by `Frame.seq`; the others are not rendered.

    Args:
        frames: of the recording, in order.
        picture_of: what the model shows for a frame.
        window_s: the times that the model has seen, with what is tolerated around them; frames outside are left out and counted.
        record: given each scored frame's figures.
    """
    sums, unrounded, depth = ScoreSums(), ScoredMean(), DepthSums()
    for frame in frames:
        if not is_heldout(frame.seq):
            continue
        reason = why_left_out(frame)
        if reason is None and not window_s[0] <= frame.time_s <= window_s[1]:
            reason = OUTSIDE
        if reason is not None:
            sums.leave_out(reason)
            continue
        picture = picture_of(frame)
        quality = sums.add(frame, picture.image)
        unrounded_db = psnr_tissue_db(picture.unrounded, frame.image, frame.mask)
        unrounded.add(unrounded_db)
        depth_mae_mm = depth.add(frame, picture.depth)
        if record is not None:
            record(
                {
                    "seq": frame.seq,
                    "time_s": frame.time_s,
                    "trained": False,
                    "model_version": picture.model_version,
                    **measures(quality),
                    "psnr_unrounded_db": unrounded_db,
                    "depth_mae_mm": finite(depth_mae_mm),
                }
            )
    return HeldOut(sums.score, unrounded.mean, depth.errors)
