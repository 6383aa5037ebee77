"""The right eye's view of a model beside what the right eye saw: a novel view where training took the left eye alone.

Colours of the two eyes differ by a straight line per channel, which is fitted to each picture that is compared, so that geometry is what counts. The
columns at the right edge, which the left eye does not see, and a border are left out; so is what the left eye's tools may hide.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.baselines import BaselineScore
from gsplat_core.evaluation.heldout import OUTSIDE
from gsplat_core.evaluation.scores import Record, Score, finite, why_left_out
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.eye_colours import typical_shift
from gsplat_core.training.metrics import PSNR_CAP_DB, ScoredMean
from gsplat_core.training.right_eye import right_tissue

EVERY = 10
"""One frame of so many is scored."""
BORDER_PX = 10
"""Left out all around, in a picture of `BORDER_OF_PX` columns or more; in proportion in a smaller one."""
BORDER_OF_PX = 360
BEYOND_TYPICAL = 1.3
"""The columns that only one eye sees, where nobody says how many: so many times the typical disparity."""
SEARCHED = 0.07
"""Semi-global matching looks so far, as a share of the width, to both sides of the typical disparity."""
MODEL = "model"
SHIFTED, MATCHED, RIGHT_BEFORE = "left_shifted", "semi_global_matching", "previous_right"


@dataclass(frozen=True)
class SecondEye:
    """What a model scores in the right eye."""

    score: Score
    """`psnr_tissue_db` is the PSNR over the pixels that count; the other measures do not exist here."""
    baselines: Mapping[str, BaselineScore]
    """By name: the left picture shifted by the typical disparity, warped by semi-global matching, and the right picture of the frame before."""
    left_out_px: int
    """Columns at the right edge that were left out."""


def evaluate_second_eye(
    frames: Iterable[Frame],
    camera: Camera,
    right_view_of: Callable[[Frame, Camera], NDArray[Any]],
    *,
    window_s: tuple[float, float] = (-math.inf, math.inf),
    left_out_px: int | None = None,
    record: Record | None = None,
) -> SecondEye | None:
    """Score every tenth frame's right view; None where no frame has a right picture and its camera.

    Args:
        frames: of the recording, in order; all of them, for the picture before is a baseline.
        camera: the left eye's.
        right_view_of: what a model shows for a frame to the right eye's camera, whose pose leads from the world: RGB [H, W, 3], uint8 or 0..1.
        window_s: the times that the model has seen.
        left_out_px: columns at the right edge, which only the right eye sees; None: `BEYOND_TYPICAL` times the typical disparity.
        record: given each scored frame's figures.
    """
    sums = _Sums()
    before: NDArray[np.uint8] | None = None
    seen = False
    for number, frame in enumerate(frames):
        right, eye = frame.right_image, frame.right_camera
        if right is None or eye is None:
            continue
        seen = True
        if number % EVERY == 0:
            reason = why_left_out(frame)
            if reason is None and not window_s[0] <= frame.time_s <= window_s[1]:
                reason = OUTSIDE
            if reason is None:
                disparity = matched_disparity(frame.image, right)
                typical = float(np.median(disparity))
                if left_out_px is None:
                    left_out_px = round(BEYOND_TYPICAL * abs(typical))
                pose = camera.world_to_camera if frame.pose is None else frame.pose
                shown = {
                    MODEL: right_view_of(frame, eye.with_pose(eye.world_to_camera @ pose)),
                    SHIFTED: moved(frame.image, np.full_like(disparity, typical)),
                    MATCHED: moved(frame.image, disparity),
                    RIGHT_BEFORE: before,
                }
                counted = _counted(frame, camera, eye, typical, left_out_px)
                found = {
                    name: line_psnr_db(other, right, counted) for name, other in shown.items() if other is not None
                }
                sums.add(frame, found, record)
            else:
                sums.left_out[reason] += 1
        before = right
    return sums.result(left_out_px or 0) if seen else None


class _Sums:
    """Of the frames that were scored."""

    def __init__(self) -> None:
        self._means: dict[str, ScoredMean] = {}
        self._counts: Counter[str] = Counter()
        self._worst, self._worst_seq = math.inf, -1
        self.left_out: Counter[str] = Counter()

    def add(self, frame: Frame, found: Mapping[str, float], record: Record | None) -> None:
        for name, value in found.items():
            self._means.setdefault(name, ScoredMean()).add(value)
            self._counts[name] += math.isfinite(value)
        if found[MODEL] < self._worst:
            self._worst, self._worst_seq = found[MODEL], frame.seq
        if record is not None:
            named = {f"{name}_db": finite(value) for name, value in found.items() if name != MODEL}
            record({"seq": frame.seq, "time_s": frame.time_s, "psnr_tissue_db": finite(found[MODEL]), **named})

    def result(self, left_out_px: int) -> SecondEye:
        means = {name: mean.mean for name, mean in self._means.items()}
        known = self._worst_seq >= 0
        score = Score(
            psnr_tissue_db=means.pop(MODEL, None), psnr_frame_db=None, ssim=None, frames=self._counts[MODEL],
            worst_db=self._worst if known else None, worst_seq=self._worst_seq if known else None,
            left_out=dict(sorted(self.left_out.items())),
        )  # fmt: skip
        baselines = {name: BaselineScore(value, None, self._counts[name]) for name, value in means.items()}
        return SecondEye(score, baselines, left_out_px)


def matched_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
    """By how many pixels the left eye sees farther to the right what the right eye sees at each of its pixels [H, W]: by semi-global matching, and
    the typical disparity where that finds nothing."""
    width = left.shape[1]
    reach = 8 * math.ceil(2 * SEARCHED * width / 16)
    least = round(typical_shift(left, right) * width) - reach
    matcher = cv2.StereoSGBM.create(least, 2 * reach, 5, 8 * 3 * 25, 32 * 3 * 25, mode=cv2.STEREO_SGBM_MODE_HH)
    # Mirrored, the right eye is the left one: disparities are then those of its pixels.
    mirrored = [np.ascontiguousarray(eye[:, ::-1]) for eye in (right, left)]
    found = matcher.compute(*mirrored)[:, ::-1].astype(np.float32) / 16
    known = found >= least
    typical = float(np.median(found[known])) if known.any() else float(least + reach)
    return np.where(known, found, np.float32(typical))


def moved(left: NDArray[np.uint8], disparity: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The left picture as the right eye sees it where its pixels have this disparity [H, W]; its edge goes on where nothing is known."""
    height, width = left.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    found = cv2.remap(left, columns + disparity, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.uint8)


def _counted(frame: Frame, camera: Camera, eye: Camera, disparity_px: float, left_out_px: int) -> NDArray[np.bool_]:
    """The pixels of the right picture that are compared, bool [H, W]."""
    counted = right_tissue(frame, camera, eye, disparity_px) > 0
    border = round(BORDER_PX * min(1.0, frame.width_px / BORDER_OF_PX))
    inner = np.zeros_like(counted)
    inner[border : frame.height_px - border, border : max(border, frame.width_px - max(border, left_out_px))] = True
    return counted & inner


def line_psnr_db(shown: NDArray[Any], true: NDArray[np.uint8], counted: NDArray[np.bool_]) -> float:
    """PSNR of a picture, in whatever unit, over the counted pixels [H, W] after the best straight line for each channel; NaN where nothing counts."""
    if not counted.any():
        return math.nan
    squared = 0.0
    for channel in range(3):
        x, y = shown[..., channel][counted].astype(np.float64), true[..., channel][counted].astype(np.float64)
        x = x - x.mean()
        rest = y - y.mean()
        rest = rest - x * ((x * rest).sum() / max((x * x).sum(), 1e-9))
        squared += float(np.square(rest).mean()) / 3
    return min(PSNR_CAP_DB, -10 * math.log10(max(squared / 255**2, 1e-10)))
