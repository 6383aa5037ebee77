"""Depth from the two eyes of a stereo scope: rectified pairs, matched frame by frame, doubted where the pictures speak against them."""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.geometry.depth_map import BELIEVED, DepthMap, doubted
from gsplat_core.geometry.disparity import Span, enlarged, find_disparity, shrunk, smoothed
from gsplat_core.geometry.eye_pair import LEAST_DISPARITY_PX, PairLook, look_at
from gsplat_core.ops.stereo_matching.stereo_matching import MOST_DISPARITIES
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.transfers import HostCopy, tensor_of

LOOK_EVERY = 30
"""Frames after which the pair is looked at again: eyes do not move against each other, and what they look at comes nearer."""
KEPT_LOOKS = 15
"""Of the looks whose rows are averaged."""
MATCHED_WIDTH_PX = 800
"""Wider pictures are matched at half their size, or a third: endoscopes blur more than a pixel of theirs, and what is fitted is a fraction of one."""
MARGIN_SHARE, MARGIN_PX = 0.2, 4
"""What is looked for beyond the disparities that were seen."""
HALF_BELIEVED_PX = 0.5
"""Standard deviation of a disparity that is believed with a confidence of a half, in pixels of the pictures that are matched."""
SAMPLED_PX = 200
"""Pixels along a row that are enough to know the range of a picture's depth."""
LEAST_BELIEVED = 0.05
"""Share of the pixels that must be believed."""
ROWS_FROM_PX = 0.05
"""Rows that are off by less are left as they are: taking it out costs sharpness."""
SAID_FROM_PX = 1.0
"""Rows that are off by more are remarked on."""
PLAUSIBLE_MM = (2.0, 1000.0)
"""Median distance of what a scope in the body can be looking at."""
SAME_FOCAL, SAME_ROW_PX, SAME_AXES = 1e-3, SAID_FROM_PX, 1e-6
"""How far the cameras of a rectified pair may differ: focal lengths as a share, rows of the principal points (what the pictures say about rows is
taken out), turned axes."""


class StereoDepth:
    """Estimates the depth of rectified pairs.

    Without the right eye's camera depth is relative, in units of the distance between the eyes; the pictures are then taken as those of parallel cameras
    with one principal point. On a GPU it works on a stream of its own: training goes on beside it, and only the thread that asks waits.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.work_on(device)
        self._forget((0, 0))

    def work_on(self, device: torch.device | str) -> None:
        """See `OnDevice`: where pictures are matched. What looks at the pair as a whole, now and then, works on the CPU."""
        self._device = torch.device(device)
        self._stream = torch.cuda.Stream(self._device) if self._device.type == "cuda" else None

    def _forget(self, size: tuple[int, int]) -> None:
        self._size = size
        self._rows: list[NDArray[np.float64]] = []
        self._span: tuple[float, float] | None = None
        self._looked: tuple[float, float] | None = None
        self._seen: tuple[float, float] | None = None
        self._look_in = 0

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """See `Estimator`."""
        if frame.right_image is None:
            return None
        shape = frame.image.shape[:2]
        if frame.new_scene is not None or shape != self._size:
            self._forget(shape)
        why = _unlike_eyes(camera, frame.right_camera)
        if why is not None:
            return doubted(shape, DepthOrigin.STEREO, why)
        left, right = grey(frame.image), grey(frame.right_image)
        # What parallel rays have: principal points may differ.
        parallel_px = 0.0 if frame.right_camera is None else float(camera.K[0, 2] - frame.right_camera.K[0, 2])
        if self._look_in == 0:
            why = self._look(left, right, frame, parallel_px)
            if why is not None:
                return doubted(shape, DepthOrigin.STEREO, why)
        self._look_in -= 1
        span = self._span_of(frame.width_px)
        if span.count > MOST_DISPARITIES:
            why = f"the eyes see points at too many distances: {span.count} disparities would have to be looked through, {MOST_DISPARITIES} can be"
            return doubted(shape, DepthOrigin.STEREO, why)
        is_first = self._seen is None
        planes = self._planes(left, right, frame, camera, span, parallel_px)
        found = self._as_depth(planes, frame, camera, parallel_px)
        widened = self._span_of(frame.width_px)
        if is_first and found.doubt is None and span != widened and widened.count <= MOST_DISPARITIES:
            # The first frame of a scene is matched as the ones after it are.
            planes = self._planes(left, right, frame, camera, widened, parallel_px)
            found = self._as_depth(planes, frame, camera, parallel_px)
        return found

    def _look(self, left: NDArray[np.uint8], right: NDArray[np.uint8], frame: Frame, parallel_px: float) -> str | None:
        """Learn rows and disparities of the pair. Returns a sentence that says why it cannot be used, or None."""
        look = look_at(left, right, frame.loss_mask)
        why = look.doubt or _unlike_distances(look, parallel_px, calibrated=frame.right_camera is not None)
        if why is not None:
            return why
        self._rows = [*self._rows, look.rows][-KEPT_LOOKS:]
        low, high = (float(value) for value in np.percentile(look.disparities, (1, 99)))
        known = self._seen or (low, high)
        self._span = self._looked = min(low, known[0]), max(high, known[1])
        self._look_in = LOOK_EVERY
        return None

    def _widen_to(self, seen: tuple[float, float]) -> None:
        """Look for what was seen in the next frame, too.

        Until the next look the span only widens, and by one margin at most: wrong matches lie anywhere in it, so that it would widen without an end, and
        pictures that are alike would be matched in another span, and otherwise, from frame to frame.
        """
        assert self._span is not None and self._looked is not None
        least, most = _widened(self._looked)
        self._span = min(self._span[0], max(seen[0], least)), max(self._span[1], min(seen[1], most))

    def _span_of(self, width_px: int) -> Span:
        """Return the disparities to look for, in pixels of the pictures that are matched."""
        assert self._span is not None
        low, high = self._span
        shrink = _shrink(width_px)
        low, high = _widened((low, high))
        return Span.around(low / shrink, high / shrink)

    def _planes(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        frame: Frame,
        camera: Camera,
        span: Span,
        parallel_px: float,
    ) -> NDArray[np.float32]:
        """Depth and confidence [2, H, W]."""
        assert self._span is not None
        rows = np.median(self._rows, axis=0)
        aligned = _with_rows_of_left(right, rows, sum(self._span) / 2)
        shrink = _shrink(frame.width_px)
        small = [shrunk(each, shrink) for each in (left, aligned, frame.image)]
        with self._beside():
            here, there, guide = _tensors_of(small, self._device)
            found = enlarged(smoothed(find_disparity(here, there, span), guide), frame.width_px, frame.height_px)
            shift = found.px - parallel_px
            known = found.known & (shift > LEAST_DISPARITY_PX)
            off_px = _off_along_rows(rows, frame.height_px, frame.width_px, self._device)
            variance = (found.error_px.square() + off_px.square()) / (HALF_BELIEVED_PX * shrink) ** 2
            depth = torch.where(known, reach_of(frame, camera) / torch.where(known, shift, 1), 0)
            planes = HostCopy(torch.stack([depth, torch.where(known, 1 / (1 + variance), 0)]))
        return planes.numpy().copy()  # frames may be kept for long, and page-locked memory is dear

    def _beside(self) -> AbstractContextManager[object]:
        return contextlib.nullcontext() if self._stream is None else torch.cuda.stream(self._stream)

    def _as_depth(self, planes: NDArray[np.float32], frame: Frame, camera: Camera, parallel_px: float) -> DepthMap:
        depth, confidence = planes
        believed = np.count_nonzero(confidence >= BELIEVED) / confidence.size
        if believed < LEAST_BELIEVED:
            self._look_in = 0
            why = f"too little of the picture could be matched between the eyes: {believed:.1%} of its pixels, {LEAST_BELIEVED:.0%} are needed"
            return doubted(depth.shape, DepthOrigin.STEREO, why)
        step = max(1, frame.width_px // SAMPLED_PX)
        some = planes[:, ::step, ::step]
        reach = reach_of(frame, camera)
        believed_depth = some[0][some[1] >= BELIEVED]
        near, far = (float(value) for value in np.percentile(believed_depth, (0.5, 99.5)))
        self._seen = reach / far + parallel_px, reach / near + parallel_px
        self._widen_to(self._seen)
        middle = float(np.median(believed_depth))
        if frame.right_camera is not None and not PLAUSIBLE_MM[0] <= middle <= PLAUSIBLE_MM[1]:
            why = f"the distances cannot be those of a scope: {middle:.3g} mm in the middle; check the distance between the eyes and its unit"
            return doubted(depth.shape, DepthOrigin.STEREO, why)
        return DepthMap(
            depth, confidence, DepthOrigin.STEREO, frame.right_camera is not None, remark=self._remark(middle, reach)
        )

    def _remark(self, middle: float, reach: float) -> str | None:
        """What is to be said of rows that are off: taken out they are, but whatever moved them may have moved columns, too."""
        off = float(np.median(self._rows, axis=0)[0])
        if abs(off) < SAID_FROM_PX:
            return None
        return (
            f"the rows of the two eyes are not the same: those of the right one were moved by {off:.1f} px; if its columns are off by as much,"
            f" depth is off by {abs(off) * middle / reach:.1%}, so check the calibration"
        )


def _widened(span: tuple[float, float]) -> tuple[float, float]:
    """Return a span of disparities with the margin at both ends."""
    margin = MARGIN_PX + MARGIN_SHARE * (span[1] - span[0])
    return span[0] - margin, span[1] + margin


def _shrink(width_px: int) -> int:
    """By which factor pictures are smaller while they are matched."""
    return -(-width_px // MATCHED_WIDTH_PX)


def variance_px2(confidence: NDArray[np.float32], width_px: int, beside: float) -> NDArray[np.float32]:
    """Variances of disparities by their confidence above 0 [H, W], in squares of the pixels of pictures of this width.

    beside: what is added, in squares of the pixels that are matched.
    """
    own = HALF_BELIEVED_PX**2 * (1 / np.maximum(confidence, np.float32(1e-6)) - 1)
    return np.asarray(_shrink(width_px) ** 2 * (own + beside), np.float32)


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Brightness [H, W] of an RGB picture."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def _unlike_eyes(left: Camera, right: Camera | None) -> str | None:
    """Why two cameras are not those of a rectified pair, in a sentence; None where they are."""
    if right is None:
        return None
    pose = right.world_to_camera
    if np.abs(pose[:3, :3] - np.eye(3)).max() > SAME_AXES or np.abs(pose[1:3, 3]).max() > SAME_AXES * abs(pose[0, 3]):
        return "the cameras are not those of a rectified pair: their axes or heights differ; rectify the pictures first"
    if abs(left.K[0, 0] / right.K[0, 0] - 1) > SAME_FOCAL or abs(left.K[1, 1] / right.K[1, 1] - 1) > SAME_FOCAL:
        return f"the cameras are not those of a rectified pair: their focal lengths are {left.K[0, 0]:.1f} and {right.K[0, 0]:.1f} px"
    if abs(left.K[1, 2] - right.K[1, 2]) > SAME_ROW_PX:
        return f"the cameras are not those of a rectified pair: their principal points are in rows {left.K[1, 2]:.1f} and {right.K[1, 2]:.1f}"
    if pose[0, 3] >= 0:
        return "the eyes are swapped in the calibration: its right camera is to the left of the left one"
    return None


def _unlike_distances(look: PairLook, parallel_px: float, *, calibrated: bool) -> str | None:
    """Why points of the two eyes cannot be at the distances that they have, in a sentence; None where they can."""
    shift = look.disparities - parallel_px
    middle = float(np.median(shift))
    if abs(middle) < LEAST_DISPARITY_PX and float(np.ptp(shift)) < 4 * LEAST_DISPARITY_PX:
        return f"the two eyes show one and the same picture: points are {middle:.1f} px apart in them"
    behind = float((shift < LEAST_DISPARITY_PX).mean())
    if behind > 0.5:
        return (
            f"the eyes are swapped: points lie {-middle:.1f} px further to the right in the right eye's picture than cameras side by side could see"
            " them; swap the pictures, or check the calibration"
        )
    if behind > 0.02:
        what = "wrong calibration" if calibrated else "eyes that are not parallel, and no calibration that says how"
        return f"some of the tissue would be behind the scope: {behind:.0%} of the points, by a {what}"
    return None


def reach_of(frame: Frame, camera: Camera) -> float:
    """Depth times disparity, for the left `camera` and the frame's right one; without that one depth is in distances between the eyes."""
    baseline = 1.0 if frame.right_camera is None else -float(frame.right_camera.world_to_camera[0, 3])
    return float(camera.K[0, 0] * baseline)


def _tensors_of(pictures: list[NDArray[np.uint8]], device: torch.device) -> list[Tensor]:
    """The pictures on `device`, by one copy."""
    together = tensor_of(np.concatenate([each.ravel() for each in pictures]), device)
    parts = together.split([each.size for each in pictures])
    return [part.reshape(each.shape) for part, each in zip(parts, pictures, strict=True)]


def _off_along_rows(rows: NDArray[np.float64], height: int, width: int, device: torch.device) -> Tensor:
    """How far disparities may be off, in pixels [H, W]: an eye that is turned or nearer moves points along its rows as it moves them across."""
    y, x = torch.linspace(-1, 1, height, device=device)[:, None], torch.linspace(-1, 1, width, device=device)
    return torch.hypot(float(rows[1]) * height / width * y, float(rows[2]) * width / height * x)


def _with_rows_of_left(right: NDArray[np.uint8], rows: NDArray[np.float64], disparity_px: float) -> NDArray[np.uint8]:
    """The right picture with each point in the row in which the left eye has it; `rows` as in `PairLook`."""
    if np.abs(rows).sum() < ROWS_FROM_PX:
        return right
    height, width = right.shape
    across, down = 2 * rows[1] / width, 2 * rows[2] / height
    move = np.array([[1, 0, 0], [across, 1 + down, rows[0] - rows[1] - rows[2] + across * disparity_px]], np.float64)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(right, move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )
