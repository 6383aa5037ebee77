"""Scores of views that training did not use: further cameras of a recording, and the right eye.

`ViewSums` scores the further views of a frame over tissue that training observed. Baselines are the
left picture, unchanged and shifted by the typical disparity.

`evaluate_second_eye` scores the right eye of a model trained on the left one. The colours of both
eyes differ by a linear map per channel, which is fitted to each picture. Columns visible only to
the right eye, a border, and tissue hidden by the left eye's tools are excluded.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.protocols import OUTSIDE, Picture
from gsplat_core.evaluation.scores import BaselineScore, Record, Score, ScoreSums, finite, why_left_out
from gsplat_core.io.recordings.truth import GroundTruth
from gsplat_core.scene.cameras import Camera, at_pixels, inverse, moved, pixel_rays, pixels_of, points_of
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import PSNR_CAP_DB, ScoredMean
from gsplat_core.training.observations import right_tissue, typical_shift

SAME_DEPTH = 0.02
"""Largest relative difference of two cameras' depths at which they count as seeing the same surface point."""
LEAST_SEEN = 0.05
"""Smallest share of a view's pixels whose tissue the training camera sees; frames with less are not scored."""


@dataclass(frozen=True)
class NovelView:
    """Scores of one view over tissue pixels that the training camera sees in the same frame."""

    name: str
    model: Score
    left: Score
    """Baseline: the left picture resampled to the view's intrinsics, as if both cameras were at the same place."""
    shifted: Score
    """Baseline: left picture reprojected as if all tissue were at its median distance.

    For a right eye this is a shift by the median disparity.
    """
    seen: float
    """Mean share of the view's pixels that are scored, because training has observed their tissue."""


class NovelViewSums:
    """Accumulator of the scores of one novel view over the frames of a recording."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._model, self._left, self._shifted = ScoreSums(), ScoreSums(), ScoreSums()
        self._seen, self._frames = 0.0, 0

    def add(self, view: Frame, seen: NDArray[np.bool_], picture: Any, left: Any, shifted: Any) -> None:
        """Score a rendered picture and the baselines against the view over the pixels `seen`. Leave out a view with a
        smaller share of them than `LEAST_SEEN`.

        Args:
            view: frame of the novel view's camera.
            seen: bool [H, W], pixels whose tissue training has observed.
            picture: picture rendered by the model [H, W, 3].
            left: baseline: the left picture resampled to the view's intrinsics, without a change of pose.
            shifted: baseline: the left picture reprojected at one typical distance.
        """
        share = float(seen.mean())
        sums = (self._model, self._left, self._shifted)
        if share < LEAST_SEEN:
            for each in sums:
                each.leave_out("hardly anything that training saw")
            return
        masked = view.with_fields(mask=seen.astype(np.uint8))
        for each, image in zip(sums, (picture, left, shifted), strict=True):
            each.add(masked, image)
        self._seen += share
        self._frames += 1

    @property
    def score(self) -> NovelView | None:
        """Scores averaged over the frames added so far; None if no frame was scored."""
        if not self._frames:
            return None
        scores = self._model.score, self._left.score, self._shifted.score
        return NovelView(self._name, *scores, self._seen / self._frames)


def seen_by_both(
    left_camera: Camera, left: Frame, left_depth: NDArray[Any] | None, camera: Camera, view: Frame
) -> NDArray[np.bool_]:
    """Return the mask [H, W] of view pixels whose tissue the left camera sees in the same frame.

    With depth of both cameras, the depths are compared. Without depth of the view, the left depth
    is projected into the view. Without any depth, all tissue pixels of the view count.

    Args:
        left_camera: camera of `left`.
        left: frame of the left camera.
        left_depth: depth [H, W] of `left`, or None.
        camera: camera of the view; its pose maps left-camera coordinates to its own.
        view: frame of the view.
    """
    tissue = np.ones(view.image.shape[:2], bool) if view.tissue is None else view.tissue != 0
    trained = np.ones(left.image.shape[:2], bool) if left.tissue is None else left.tissue != 0
    if left_depth is None:
        return tissue
    pose = camera.world_to_camera
    left_known = trained & (left_depth > 0)
    if view.depth is not None:
        points = moved(inverse(pose), points_of(camera, view.depth))
        z = at_pixels(np.where(left_known, left_depth, 0), pixels_of(left_camera, points))
        return np.asarray(tissue & (view.depth > 0) & (np.abs(z - points[..., 2]) < SAME_DEPTH * points[..., 2]))
    pixels = pixels_of(camera, moved(pose, points_of(left_camera, left_depth)[left_known]))
    height, width = view.height_px, view.width_px
    reached = np.zeros((height, width), np.uint8)
    column, row = (np.floor(np.nan_to_num(pixels[:, k], nan=-1)).astype(np.int64) for k in (0, 1))
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    reached[row[inside], column[inside]] = 1
    # Pixels are projected one by one, which leaves gaps where the view's camera is nearer to the tissue.
    closed = cv2.morphologyEx(reached, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return np.asarray(tissue & (closed != 0))


def moved_picture(left_camera: Camera, image: NDArray[np.uint8], camera: Camera, distance: float) -> NDArray[np.uint8]:
    """Reproject the left picture to a view as a plane at one distance, with replicated edges."""
    back = inverse(camera.world_to_camera)
    rays = pixel_rays(camera) @ back[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (distance - back[2, 3]) / rays[..., 2]
    pixels = pixels_of(left_camera, rays * reach[..., None] + back[:3, 3])
    at = np.nan_to_num(pixels - 0.5, nan=-1e4, posinf=1e4, neginf=-1e4).clip(-1e4, 1e4).astype(np.float32)
    moved_ = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved_, np.uint8)


Pose = NDArray[np.float64]
Shown = Callable[[Camera, Frame], Picture]
"""Callback that renders a model at a frame's time from a camera in model space."""


class ViewSums:
    """Novel-view scores accumulated over frames in any order.

    Camera positions are divided by `scale`, the factor that converts model lengths to the recording's unit.
    """

    def __init__(self, camera: Camera, shown: Shown, truth: GroundTruth, scale: float = 1.0) -> None:
        """Create an empty accumulator for frames of `camera`."""
        self._camera, self._shown, self._truth, self._scale = camera, shown, truth, scale
        self._sums: dict[str, NovelViewSums] = {}

    def add(self, frame: Frame, own: Camera, depth: NDArray[Any] | None) -> None:
        """Score each novel view of a frame.

        Args:
            frame: frame of the training camera.
            own: camera of the frame in model space.
            depth: depth [H, W] rendered by the model from `own`; None to render it if needed.
        """
        true = self._truth.depth_of(frame)
        for name, camera, view in _views_of(frame, self._truth):
            seen = seen_by_both(self._camera, frame, true, camera, view)
            pose = camera.world_to_camera.copy()
            pose[:3, 3] /= self._scale
            picture = self._shown(camera.with_pose(pose @ own.world_to_camera), frame)
            distance = self._distance(frame, own, true, depth)
            shifted = frame.image if distance is None else moved_picture(self._camera, frame.image, camera, distance)
            left = moved_picture(self._camera, frame.image, camera.with_pose(np.eye(4)), 1.0)
            self._sums.setdefault(name, NovelViewSums(name)).add(view, seen, picture.image, left, shifted)

    def _distance(
        self, frame: Frame, own: Camera, true: NDArray[Any] | None, depth: NDArray[Any] | None
    ) -> float | None:
        """Return the median tissue depth in the recording's unit: true if known, otherwise the model's; None without both."""
        known = (
            np.zeros(0) if true is None else true[(true > 0) & (True if frame.tissue is None else frame.tissue != 0)]
        )
        if not known.size:
            shows = self._shown(own, frame).depth if depth is None else depth
            known = self._scale * shows[shows > 0]
        return float(np.median(known)) if known.size else None

    @property
    def scores(self) -> tuple[NovelView, ...]:
        """Scores of all views, averaged over the frames added so far."""
        return tuple(found for each in self._sums.values() if (found := each.score) is not None)


def _views_of(frame: Frame, truth: GroundTruth) -> Iterator[tuple[str, Camera, Frame]]:
    """Yield name, camera and picture of each further camera of a frame: the right eye, and the novel views of the recording."""
    if frame.right_image is not None and frame.right_camera is not None:
        yield "right", frame.right_camera, Frame(frame.seq, frame.pts_ns, frame.right_image)
    for view in truth.views:
        yield view.name, view.camera, view.read(frame.seq)


EVERY = 10
"""Interval in frames between two frames of which the right eye's view is scored."""
BORDER_PX = 10
"""Width in pixels of the excluded border at a picture width of `BORDER_OF_PX` or more.

Proportionally less in smaller pictures.
"""
BORDER_OF_PX = 360
BEYOND_TYPICAL = 1.3
"""Width of the unscored columns at the right edge, which only the right eye sees, in multiples of the typical disparity. Used if
no width is given.
"""
SEARCHED = 0.07
"""Largest difference from the typical disparity that semi-global matching searches, as a share of the picture's width."""
MODEL = "model"
SHIFTED, MATCHED, RIGHT_BEFORE = "left_shifted", "semi_global_matching", "previous_right"


@dataclass(frozen=True)
class SecondEye:
    """Score of a model in the right eye's view."""

    score: Score
    """Only `psnr_tissue_db`, the PSNR over compared pixels, is available."""
    baselines: Mapping[str, BaselineScore]
    """Scores by baseline name.

    The baselines are the left picture shifted by the typical disparity, the left picture warped by
    semi-global matching, and the previous right picture.
    """
    left_out_px: int
    """Number of pixel columns at the right edge that are not scored, because only the right eye sees them."""


def evaluate_second_eye(
    frames: Iterable[Frame],
    camera: Camera,
    right_view_of: Callable[[Frame, Camera], NDArray[Any]],
    *,
    window_s: tuple[float, float] = (-math.inf, math.inf),
    left_out_px: int | None = None,
    record: Record | None = None,
) -> SecondEye | None:
    """Score the right view of every tenth frame.

    Args:
        frames: all frames of the recording in order; the previous right picture is a baseline.
        camera: camera of the left eye.
        right_view_of: callback that renders a frame with the right eye's camera, whose pose maps
            from the world. Returns RGB [H, W, 3], uint8 or float in 0..1.
        window_s: first and last time in seconds that the model was trained on.
        left_out_px: number of excluded columns at the right edge, visible only to the right eye.
            None selects `BEYOND_TYPICAL` times the typical disparity.
        record: callback that receives the figures of each scored frame.

    Returns:
        Scores and baselines, or None if no frame has a right picture with a camera.
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
                    SHIFTED: warped_by_disparity(frame.image, np.full_like(disparity, typical)),
                    MATCHED: warped_by_disparity(frame.image, disparity),
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
    """Accumulator of the mean PSNR of the model's right view and of each baseline over the scored frames."""

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
    """Return the disparity [H, W] in pixels of each right-eye pixel by semi-global matching.

    Disparity is the column in the left picture minus the column in the right picture. Unmatched
    pixels get the median disparity.
    """
    width = left.shape[1]
    reach = 8 * math.ceil(2 * SEARCHED * width / 16)
    least = round(typical_shift(left, right) * width) - reach
    matcher = cv2.StereoSGBM.create(least, 2 * reach, 5, 8 * 3 * 25, 32 * 3 * 25, mode=cv2.STEREO_SGBM_MODE_HH)
    # In mirrored pictures the right eye takes the role of the left one, so disparities belong to its pixels.
    mirrored = [np.ascontiguousarray(eye[:, ::-1]) for eye in (right, left)]
    found = matcher.compute(*mirrored)[:, ::-1].astype(np.float32) / 16
    known = found >= least
    typical = float(np.median(found[known])) if known.any() else float(least + reach)
    return np.where(known, found, np.float32(typical))


def warped_by_disparity(left: NDArray[np.uint8], disparity: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Warp the left picture to the right eye by the right eye's disparity [H, W] in pixels.

    Columns beyond the left picture repeat its edge.
    """
    height, width = left.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    found = cv2.remap(left, columns + disparity, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.uint8)


def _counted(frame: Frame, camera: Camera, eye: Camera, disparity_px: float, left_out_px: int) -> NDArray[np.bool_]:
    """Return the mask [H, W] of the right picture's pixels that are scored: tissue that the left eye sees, without the border."""
    counted = right_tissue(frame, camera, eye, disparity_px) > 0
    border = round(BORDER_PX * min(1.0, frame.width_px / BORDER_OF_PX))
    inner = np.zeros_like(counted)
    inner[border : frame.height_px - border, border : max(border, frame.width_px - max(border, left_out_px))] = True
    return counted & inner


def line_psnr_db(shown: NDArray[Any], true: NDArray[np.uint8], counted: NDArray[np.bool_]) -> float:
    """Return the PSNR in dB after the best linear fit per channel, over the counted pixels.

    Args:
        shown: picture [H, W, 3] in any unit.
        true: reference uint8 [H, W, 3].
        counted: bool [H, W].

    Returns:
        PSNR, NaN if no pixel counts.
    """
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
