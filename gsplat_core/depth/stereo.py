"""Depth from stereo pairs, frame by frame.

Disparity is x in the left picture minus x in the right picture, in pixels. Semi-global matching selects the disparity
of each pixel in sixteenths of a pixel, which cluster around whole pixels. A local sub-pixel fit then moves each
disparity to the best photometric agreement and estimates its standard deviation. Both steps are ops of
`gsplat_core.ops` for CPU and CUDA. Tensors stay on their device, and the matching functions do not synchronise with it.

A pair is checked before its depth is used: range of disparities, alignment of rows, and a camera that agrees with the
pictures. Corners of the left picture are searched in the right one, first along the row at low resolution over the
whole disparity range, then with Lucas-Kanade optical flow in both directions at full size. In a rectified pair
corresponding points are in the same row.
"""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.depth.maps import DepthMap, Estimator, doubted
from gsplat_core.geometry.tracks import Points, followed
from gsplat_core.ops.disparity_fit import fit_disparities
from gsplat_core.ops.edge_aware_filter import smooth_within_edges
from gsplat_core.ops.stereo_matching import (
    COUNT_STEP,
    MOST_DISPARITIES,
    SIXTEENTHS,
    UNKNOWN,
    match_disparities,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, STEREO, Frame
from gsplat_core.transfers import HostCopy, tensor_of

EDGE_ERROR_PX = 1.5
"""Standard deviation, in pixels, of the error that is added to that of matched disparities near edges and holes."""
SMOOTHNESS, SMOOTH_GREY = 100.0, 5.0
"""Strength of the edge-aware filter of disparities, and the difference of neighbouring grey values at which it falls to 1/e."""
LEAST_VARIANCE_PX2 = 0.05
"""Variance in pixels² that is added to each disparity's variance in the filter, to limit the weight of the best values."""
LEAST_WEIGHT = 1e-4
"""Smallest filtered weight of known disparities for a smoothed disparity to count as known."""


@dataclass(frozen=True)
class Disparity:
    """Disparity of each pixel of the left picture, with validity and standard deviation."""

    px: Tensor
    """Disparity in pixels, float32 [H, W]; 0 where unknown."""
    known: Tensor
    """Bool mask [H, W], True where the disparity is known."""
    error_px: Tensor
    """Standard deviation in pixels estimated from the pictures, float32 [H, W]; infinite where unknown."""


@dataclass(frozen=True)
class Span:
    """Search range of disparities: `count` whole pixels, a multiple of 16, starting at `lowest`."""

    lowest: int
    count: int

    @classmethod
    def around(cls, low: float, high: float) -> Span:
        """Return the smallest search range that contains the disparities `low` to `high` in pixels."""
        lowest = int(np.floor(low))
        return cls(lowest, COUNT_STEP * max(1, int(np.ceil((high - lowest + 1) / COUNT_STEP))))


def find_disparity(left: Tensor, right: Tensor, span: Span) -> Disparity:
    """Match two rectified grey pictures.

    Args:
        left, right: uint8 [H, W] on one device; corresponding points are in the same row.
        span: search range.

    Raises:
        InvalidInput: for a range of more than 256 disparities.
    """
    matches = match_disparities(left, right, span.lowest, span.count)
    fitted = fit_disparities(left, right, matches.sixteenths)
    doubtful = torch.where(matches.one_surface, fitted.error_px, fitted.error_px.square().add(EDGE_ERROR_PX**2).sqrt())
    return Disparity(fitted.px, matches.sixteenths != UNKNOWN, doubtful)


def match(
    left: NDArray[np.uint8], right: NDArray[np.uint8], span: Span
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Match two grey pictures uint8 [H, W] on the CPU without the sub-pixel fit. Returns disparity
    float32 [H, W] and validity bool [H, W].
    """
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    found = match_disparities(
        torch.from_numpy(left), torch.from_numpy(right), span.lowest, span.count
    ).sixteenths.numpy()
    known = found != UNKNOWN
    return np.where(known, found / np.float32(SIXTEENTHS), 0).astype(np.float32), known


def smoothed(found: Disparity, guide: Tensor) -> Disparity:
    """Smooth known disparities with an edge-aware filter, each weighted by its inverse variance.

    Args:
        found: disparity to smooth.
        guide: picture [H, W] or [H, W, 3] whose edges are preserved.
    """
    weight = torch.where(found.known, 1 / (LEAST_VARIANCE_PX2 + found.error_px.square()), 0)
    total, share = smooth_within_edges(torch.stack([weight * found.px, weight]), guide, SMOOTHNESS, SMOOTH_GREY)
    known = found.known & (share > LEAST_WEIGHT)
    return Disparity(torch.where(known, total / share.clamp(min=LEAST_WEIGHT), 0), known, found.error_px)


def shrunk(picture: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Reduce a picture by an integer factor with area averaging."""
    if factor == 1:
        return picture
    size = picture.shape[1] // factor, picture.shape[0] // factor
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def enlarged(found: Disparity, width_px: int, height_px: int) -> Disparity:
    """Upsample a disparity of reduced pictures to full size. A pixel is known if all values it is
    interpolated from are known.
    """
    if (height_px, width_px) == tuple(found.px.shape):
        return found
    factor = width_px / found.px.shape[1]
    planes = torch.stack([found.known.float(), found.px, torch.where(found.known, found.error_px, 0)])
    share, px, error_px = torch.nn.functional.interpolate(
        planes[None], (height_px, width_px), mode="bilinear", align_corners=False
    )[0]
    known = share > 0.99
    return Disparity(
        torch.where(known, factor * px / share.clamp(min=0.5), 0),
        known,
        torch.where(known, factor * error_px, torch.inf),
    )


COARSE_WIDTH_PX = 200
"""Picture width at which the whole disparity range is searched, in pixels."""
COARSE_RANGE = (-0.3, 0.5)
"""Searched disparities as shares of the width. The negative part is implausible and reveals swapped eyes."""
CORNERS, CORNER_QUALITY, CORNER_APART_PX = 400, 0.01, 7
FLOW_WINDOW_PX = 21
"""Side of the window in which a point is followed to the other eye, in pixels."""
SATURATED = 250
"""Grey value from which a pixel counts as saturated."""
BACK_PX = 0.5
"""Largest accepted forward-backward error of the flow, in pixels."""
LEAST_POINTS = 24
"""Fewest points found in both eyes with which a stereo pair can be checked."""
LEAST_SHARE = 0.2
"""Smallest share of the corners that must be found in the other eye, and of the found corners that must fit the common
row offset.
"""
ROW_ERROR_PX = 1.5
"""Deviation in pixels from the fitted row difference between the eyes above which a point counts as wrongly matched."""
MOST_SLOPE_PX = 1.0
"""Largest accepted row difference between the eyes at the edge of the picture, in pixels, minus the common row offset."""
MOST_OFFSET = 0.03
"""Largest accepted row offset between the eyes that all points have in common, as a share of the picture's height."""
LEAST_DISPARITY_PX = 0.5
"""Disparity in pixels, after subtracting the calibration's, up to which a point has no depth. A pair whose median is
smaller shows the same picture twice, or tissue at infinity.
"""


@dataclass(frozen=True)
class PairCheck:
    """Result of the check of one stereo pair. If `doubt` is set, the other fields are meaningless."""

    disparities: Points
    """Disparities [N] of points found in both eyes, in pixels."""
    rows: NDArray[np.float64]
    """Row difference right minus left in pixels, [3]: value in the middle of the picture, and
    increments at its right and lower edges.
    """
    points: Points
    """Positions in the left picture of the points found in both eyes [N, 2], as (x, y) in pixels."""
    error_px: float
    """Standard error of the disparities in pixels, from the scatter of the points across the rows."""
    doubt: str | None = None


def check_pair(left: NDArray[np.uint8], right: NDArray[np.uint8], usable: NDArray[np.uint8] | None = None) -> PairCheck:
    """Compare two grey pictures of a stereo pair; return their row differences, disparities and any doubt.

    Args:
        left, right: uint8 [H, W].
        usable: uint8 [H, W], 0 where pixels are ignored, or None.
    """
    here, there, corners = _points_in_both(left, right, usable)
    dim, bright = (float(np.mean(each)) for each in (left < SATURATED, left >= SATURATED))
    if corners < LEAST_POINTS:
        why = "is overexposed" if bright > dim else "has too little texture"
        return _doubt(
            f"the picture {why}: {corners} points could be compared between the eyes, {LEAST_POINTS} are needed"
        )
    if len(here) < max(LEAST_POINTS, LEAST_SHARE * corners):
        return _doubt(
            f"the two eyes show different content: {len(here)} of {corners} points of the left picture were found in the right one; "
            "check that both show one scene at one time and that the eyes are not swapped"
        )
    height, width = left.shape
    rows, agree = _fitted_rows(here, there[:, 1] - here[:, 1], width, height)
    if agree.mean() < LEAST_SHARE or agree.sum() < LEAST_POINTS:
        return _doubt(
            "corresponding points of the two eyes are not in common rows; check the calibration used for rectification"
        )
    slope, offset = float(np.abs(rows[1:]).max()), float(abs(rows[0]))
    if slope > MOST_SLOPE_PX:
        return _doubt(
            f"the pair is not rectified: rows of the two eyes differ by up to {offset + slope:.1f} px and not uniformly across the picture; "
            "check the calibration"
        )
    if offset > MOST_OFFSET * height:
        return _doubt(
            f"the pair is not rectified: the right eye's rows are off by {rows[0]:.1f} px; check the calibration"
        )
    scatter = there[agree, 1] - here[agree, 1] - _basis(here[agree], width, height) @ rows
    error_px = 1.4826 * float(np.median(np.abs(scatter)))
    return PairCheck((here - there)[agree, 0], rows, here[agree], error_px)


def _doubt(text: str) -> PairCheck:
    return PairCheck(np.zeros(0, np.float32), np.zeros(3), np.zeros((0, 2), np.float32), 0.0, text)


def _points_in_both(
    left: NDArray[np.uint8], right: NDArray[np.uint8], usable: NDArray[np.uint8] | None
) -> tuple[Points, Points, int]:
    """Return points [N, 2] (x, y) of the left picture, the same points in the right picture, and
    the number of corners tried.
    """
    shown = np.asarray(cv2.erode((left < SATURATED).astype(np.uint8), np.ones((7, 7), np.uint8)), np.uint8)
    if usable is not None:
        # A window that contains the border of the field of view would find the border, which has no disparity.
        window = np.ones((FLOW_WINDOW_PX, FLOW_WINDOW_PX), np.uint8)
        shown &= np.asarray(cv2.erode(usable, window), np.uint8)
    corners = cv2.goodFeaturesToTrack(_levelled(left), CORNERS, CORNER_QUALITY, CORNER_APART_PX, mask=shown)
    none = np.zeros((0, 2), np.float32)
    if corners is None:
        return none, none, 0
    start = np.ascontiguousarray(corners[:, 0], np.float32)
    guess = start.copy()
    guess[:, 0] -= _coarse_disparity(left, right, start)
    found, misses_px = followed(left, right, start, guess, window_px=FLOW_WINDOW_PX, levels=2)
    kept = misses_px < BACK_PX
    return start[kept], found[kept], len(start)


def _levelled(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Set pixels without texture above noise level to zero, so that a black picture has no corners."""
    return np.where(cv2.GaussianBlur(cv2.absdiff(grey, cv2.blur(grey, (9, 9))), (0, 0), 2) > 1, grey, 0).astype(
        np.uint8
    )


def _coarse_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8], at: Points) -> NDArray[np.float32]:
    """Return approximate disparities [N] at points [N, 2], or the median disparity where none was found."""
    factor = max(1.0, left.shape[1] / COARSE_WIDTH_PX)
    size = max(1, round(left.shape[1] / factor)), max(1, round(left.shape[0] / factor))
    small = [np.asarray(cv2.resize(each, size, interpolation=cv2.INTER_AREA), np.uint8) for each in (left, right)]
    low, high = COARSE_RANGE
    found, known = match(small[0], small[1], Span.around(low * size[0], high * size[0]))
    factor = left.shape[1] / size[0]
    found, known = _within_both(found, known)
    if not known.any():
        return np.zeros(len(at), np.float32)
    columns = np.clip((at[:, 0] / factor).astype(int), 0, size[0] - 1)
    lines = np.clip((at[:, 1] / factor).astype(int), 0, size[1] - 1)
    typical = np.float32(np.median(found[known]))
    return np.asarray(np.where(known[lines, columns], found[lines, columns], typical) * np.float32(factor), np.float32)


def _within_both(found: NDArray[np.float32], known: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    there = np.arange(found.shape[1], dtype=np.float32) - found
    return found, known & (there >= 0) & (there <= found.shape[1] - 1)


def _basis(here: Points, width: int, height: int) -> NDArray[np.float64]:
    x, y = 2 * here[:, 0] / width - 1, 2 * here[:, 1] / height - 1
    return np.stack([np.ones(len(here)), x, y], axis=1).astype(np.float64)


def _fitted_rows(here: Points, lower: Points, width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Fit a linear function of the position to the row differences `lower` [N] (right minus left, in pixels) of points.

    `here` [N, 2] are the points' positions in the left picture. The method is iteratively reweighted least squares,
    starting from the median difference without slopes.

    Returns:
        Coefficients [3] as in `PairCheck.rows`, and the mask [N] of the inliers.
    """
    basis = _basis(here, width, height)
    rows = np.array([float(np.median(lower)), 0.0, 0.0])
    scale = 4 * ROW_ERROR_PX
    for _ in range(12):
        off = lower - basis @ rows
        weight = 1 / (1 + (off / scale) ** 2) ** 2
        normal = (basis * weight[:, None]).T @ basis + np.diag([0.0, 1e-3, 1e-3])
        rows = np.linalg.solve(normal, (basis * weight[:, None]).T @ lower)
        scale = max(ROW_ERROR_PX / 3, scale / 1.5)
    return rows, np.abs(lower - basis @ rows) < ROW_ERROR_PX


CHECK_EVERY = 30
"""Number of frames between two checks of the stereo pair. The eyes are rigid, but the distance of the tissue changes."""
KEPT_CHECKS = 15
"""Number of newest pair checks whose row offsets are combined by their median."""
MATCHED_WIDTH_PX = 800
"""Width above which pictures are matched at an integer fraction of their size. Endoscopes blur by
more than one of their pixels, and the fit is sub-pixel.
"""
COMPANY_PX = 15
"""Side of the window around a confident pixel in which at least half of the pixels must be confident as well; otherwise the pixel
is rejected. In pixels of the matched pictures.
"""
MATCH_WINDOW_PX = 15
"""Side of the correlation window of stereo matching, in pixels of the matched pictures."""
MARGIN_SHARE, MARGIN_PX = 0.2, 4
"""Margin of the search range around the observed disparities, as a share of their span and in pixels."""
HALF_BELIEVED_PX = 0.5
"""Standard deviation of a disparity at which its confidence is one half, in pixels of the matched pictures."""
SAMPLED_PX = 200
"""Number of pixels along a row (up to twice as many) from which a picture's depth range and typical error are computed."""
LEAST_BELIEVED = 0.05
"""Share of confident pixels below which the depth map is rejected."""
ROWS_FROM_PX = 0.05
"""Row difference between the eyes in pixels below which rows are not corrected, since resampling costs sharpness."""
SAID_FROM_PX = 1.0
"""Row difference between the eyes in pixels above which the user gets a remark."""
PLAUSIBLE_MM = (2.0, 1000.0)
"""Plausible median distances for a scope inside the body, in millimetres."""
SAME_FOCAL, SAME_ROW_PX, SAME_AXES = 1e-3, SAID_FROM_PX, 1e-6
"""Tolerances of a rectified pair: relative difference of focal lengths, row difference of principal points in pixels
(row offsets are corrected), and largest deviation of an element of the rotation from the identity. The last one also
limits the offset in y and z relative to that in x.
"""


class StereoDepth(Estimator):
    """Depth estimator for rectified stereo pairs.

    Without the right camera's calibration depth is relative, in units of the baseline, assuming
    parallel cameras with a common principal point. On a GPU it runs on its own stream concurrently
    with training; only the calling thread waits.
    """

    origin = STEREO
    needs = "right_image"
    evidence = "the two eyes"

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.work_on(device)
        self._forget((0, 0))

    def work_on(self, device: torch.device | str) -> None:
        """Run the matching on `device` from now on. The occasional check of the pair runs on the CPU."""
        self._device = torch.device(device)
        self._stream = torch.cuda.Stream(self._device) if self._device.type == "cuda" else None

    def _forget(self, size: tuple[int, int]) -> None:
        self._size = size
        self._rows: list[NDArray[np.float64]] = []
        self._span: tuple[float, float] | None = None
        self._checked: tuple[float, float] | None = None
        self._seen: tuple[float, float] | None = None
        self._frames_to_check = 0

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """Estimate the depth of a frame by matching its two pictures; None without a right picture. The map is rejected
        (`doubt`) if the pictures are no usable rectified pair.
        """
        if frame.right_image is None:
            return None
        shape = frame.image.shape[:2]
        if frame.new_scene is not None or shape != self._size:
            self._forget(shape)
        why = _why_not_rectified(camera, frame.right_camera)
        if why is not None:
            return doubted(shape, STEREO, why)
        left, right = grey(frame.image), grey(frame.right_image)
        # Disparity of points at infinity. It is not 0 if the principal points differ.
        parallel_px = 0.0 if frame.right_camera is None else float(camera.K[0, 2] - frame.right_camera.K[0, 2])
        check = None
        if self._frames_to_check == 0:
            check = self._check(left, right, frame, parallel_px)
            if check.doubt is not None:
                return doubted(shape, STEREO, check.doubt)
        self._frames_to_check -= 1
        span = self._span_of(frame.width_px)
        if span.count > MOST_DISPARITIES:
            why = f"the range of distances is too large: {span.count} disparities would have to be searched, at most {MOST_DISPARITIES} are supported"
            return doubted(shape, STEREO, why)
        is_first = self._seen is None
        planes = self._planes(left, right, frame, camera, span, parallel_px)
        found = self._as_depth(planes, frame, camera, parallel_px)
        widened = self._span_of(frame.width_px)
        if is_first and found.doubt is None and span != widened and widened.count <= MOST_DISPARITIES:
            # Match the first frame of a scene again with its extended range, which the following frames use, too.
            planes = self._planes(left, right, frame, camera, widened, parallel_px)
            found = self._as_depth(planes, frame, camera, parallel_px)
        why = None if check is None or found.doubt is not None else _why_wrong(found, check, frame, camera, parallel_px)
        if why is not None:
            self._frames_to_check = 0
            return doubted(shape, STEREO, why)
        return found if found.doubt is not None else replace(found, error=self._typical_error(found, frame, camera))

    def _typical_error(self, found: DepthMap, frame: Frame, camera: Camera) -> float:
        """Return the median relative standard error of confident depth; the one assumed for stereo depth if there is none."""
        step = max(1, frame.width_px // SAMPLED_PX)
        some = replace(found, depth=found.depth[::step, ::step], confidence=found.confidence[::step, ::step])
        known = (some.confidence >= BELIEVED) & (some.depth > 0)
        if not known.any():
            return STEREO.relative_error
        return float(np.median((self.standard_error(some, frame, camera)[known]) / some.depth[known]))

    def standard_error(self, found: DepthMap, frame: Frame, camera: Camera) -> NDArray[np.float32]:
        """Return the standard error of an estimated depth map [H, W], in the depth's unit; meaningless where depth is unknown.

        It combines the error of matching with that of the calibration. The calibration is assumed to be wrong along
        the rows by as much as across them, which the pictures show.
        """
        beside = float(np.median(self._rows, axis=0)[0]) / shrink_of(frame.width_px) if self._rows else 0.0
        return _depth_error(variance_px2(found.confidence, frame.width_px, beside**2), found.depth, frame, camera)

    def _check(self, left: NDArray[np.uint8], right: NDArray[np.uint8], frame: Frame, parallel_px: float) -> PairCheck:
        """Check the pair. Unless it is doubtful, update its row offsets and extend the disparity range."""
        check = check_pair(left, right, frame.loss_mask)
        why = check.doubt or _why_implausible(check, parallel_px, calibrated=frame.right_camera is not None)
        if why is not None:
            return replace(check, doubt=why)
        self._rows = [*self._rows, check.rows][-KEPT_CHECKS:]
        low, high = (float(value) for value in np.percentile(check.disparities, (1, 99)))
        known = self._seen or (low, high)
        self._span = self._checked = min(low, known[0]), max(high, known[1])
        self._frames_to_check = CHECK_EVERY
        return check

    def _widen_to(self, seen: tuple[float, float]) -> None:
        """Extend the search range to the disparities `seen` (lowest, highest) of the last frame.

        Until the next check of the pair the range only grows, by at most one margin. Wrong matches occur anywhere in
        the range and would otherwise widen it without limit. A stable range also matches similar pictures alike.
        """
        assert self._span is not None and self._checked is not None
        least, most = _widened(self._checked)
        self._span = min(self._span[0], max(seen[0], least)), max(self._span[1], min(seen[1], most))

    def _span_of(self, width_px: int) -> Span:
        """Return the search range of disparities with its margins, in pixels of the reduced pictures that are matched."""
        assert self._span is not None
        low, high = self._span
        shrink = shrink_of(width_px)
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
        """Match the pair in the search range `span` and return depth and confidence, stacked as [2, H, W]."""
        assert self._span is not None
        rows = np.median(self._rows, axis=0)
        aligned = with_rows_of_left(right, rows, sum(self._span) / 2)
        shrink = shrink_of(frame.width_px)
        small = [shrunk(each, shrink) for each in (left, aligned, frame.image)]
        with self._on_own_stream():
            here, there, guide = _tensors_of(small, self._device)
            found = enlarged(smoothed(find_disparity(here, there, span), guide), frame.width_px, frame.height_px)
            shift = found.px - parallel_px
            known = found.known & (shift > LEAST_DISPARITY_PX)
            if frame.loss_mask is not None:
                known &= self._inside_both(frame.loss_mask, found.px, shrink)
            off_px = _off_along_rows(rows, frame.height_px, frame.width_px, self._device)
            variance = (found.error_px.square() + off_px.square()) / (HALF_BELIEVED_PX * shrink) ** 2
            depth = torch.where(known, reach_of(frame, camera) / torch.where(known, shift, 1), 0)
            planes = HostCopy(torch.stack([depth, torch.where(known, 1 / (1 + variance), 0)]))
        # Copy out of page-locked memory, which is scarce, because frames may be kept for long.
        both = planes.numpy().copy()
        both[1] *= _has_company(both[1], shrink)
        return both

    def _inside_both(self, usable: NDArray[np.uint8], disparity_px: Tensor, shrink: int) -> Tensor:
        """Return a bool mask [H, W] of the pixels whose matching windows are inside the field of view of both eyes.

        The field is that of the left eye. The right one of a stereo scope has the same outline.
        """
        window = np.ones((shrink * MATCH_WINDOW_PX, shrink * MATCH_WINDOW_PX), np.uint8)
        inside = tensor_of(np.asarray(cv2.erode(usable, window), np.uint8), self._device) > 0
        columns = torch.arange(usable.shape[1], device=self._device) - disparity_px.round().long()
        return inside & inside.gather(1, columns.clamp(0, usable.shape[1] - 1)) & (columns >= 0)

    def _on_own_stream(self) -> AbstractContextManager[object]:
        return contextlib.nullcontext() if self._stream is None else torch.cuda.stream(self._stream)

    def _as_depth(self, planes: NDArray[np.float32], frame: Frame, camera: Camera, parallel_px: float) -> DepthMap:
        depth, confidence = planes
        believed = np.count_nonzero(confidence >= BELIEVED) / confidence.size
        if believed < LEAST_BELIEVED:
            self._frames_to_check = 0
            why = f"too little of the picture could be matched between the eyes: {believed:.1%} of its pixels, {LEAST_BELIEVED:.0%} are needed"
            return doubted(depth.shape, STEREO, why)
        step = max(1, frame.width_px // SAMPLED_PX)
        some = planes[:, ::step, ::step]
        reach = reach_of(frame, camera)
        believed_depth = some[0][some[1] >= BELIEVED]
        near, far = (float(value) for value in np.percentile(believed_depth, (0.5, 99.5)))
        self._seen = reach / far + parallel_px, reach / near + parallel_px
        self._widen_to(self._seen)
        middle = float(np.median(believed_depth))
        if frame.right_camera is not None and not PLAUSIBLE_MM[0] <= middle <= PLAUSIBLE_MM[1]:
            why = f"the distances are implausible for a scope: {middle:.3g} mm in the middle; check the baseline and its unit"
            return doubted(depth.shape, STEREO, why)
        return DepthMap(depth, confidence, STEREO, frame.right_camera is not None, remark=self._remark(middle, reach))

    def _remark(self, middle: float, reach: float) -> str | None:
        """Return a message for the user about corrected row offsets between the eyes, whose cause may have shifted columns as
        well; None for an offset below `SAID_FROM_PX`.
        """
        off = float(np.median(self._rows, axis=0)[0])
        if abs(off) < SAID_FROM_PX:
            return None
        return (
            f"the rows of the two eyes differ: the right eye's rows were moved by {off:.1f} px; if its columns are off by as much,"
            f" depth is off by {abs(off) * middle / reach:.1%}, so check the calibration"
        )


def _widened(span: tuple[float, float]) -> tuple[float, float]:
    """Return a range of disparities (lowest, highest) in pixels, extended at both ends by the margin of the search range."""
    margin = MARGIN_PX + MARGIN_SHARE * (span[1] - span[0])
    return span[0] - margin, span[1] + margin


def shrink_of(width_px: int) -> int:
    """Return the integer factor by which pictures are reduced for matching."""
    return -(-width_px // MATCHED_WIDTH_PX)


def variance_px2(confidence: NDArray[np.float32], width_px: int, beside: float) -> NDArray[np.float32]:
    """Return variances of disparities from their confidence.

    Args:
        confidence: float32 [H, W], above 0.
        width_px: width of the pictures.
        beside: additional variance, in squared pixels of the matched pictures.

    Returns:
        float32 [H, W] in squared pixels of pictures of `width_px`.
    """
    own = HALF_BELIEVED_PX**2 * (1 / np.maximum(confidence, np.float32(1e-6)) - 1)
    return np.asarray(shrink_of(width_px) ** 2 * (own + beside), np.float32)


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the grey levels uint8 [H, W] of an RGB picture [H, W, 3]."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def _why_not_rectified(left: Camera, right: Camera | None) -> str | None:
    """Return the reason why two cameras are not a rectified pair, as a sentence; None if they are, or without `right`."""
    if right is None:
        return None
    pose = right.world_to_camera
    if np.abs(pose[:3, :3] - np.eye(3)).max() > SAME_AXES or np.abs(pose[1:3, 3]).max() > SAME_AXES * abs(pose[0, 3]):
        return "the cameras are not a rectified pair: their axes or heights differ; rectify the pictures first"
    if abs(left.K[0, 0] / right.K[0, 0] - 1) > SAME_FOCAL or abs(left.K[1, 1] / right.K[1, 1] - 1) > SAME_FOCAL:
        return f"the cameras are not a rectified pair: their focal lengths are {left.K[0, 0]:.1f} and {right.K[0, 0]:.1f} px"
    if abs(left.K[1, 2] - right.K[1, 2]) > SAME_ROW_PX:
        return f"the cameras are not a rectified pair: their principal points are in rows {left.K[1, 2]:.1f} and {right.K[1, 2]:.1f}"
    if pose[0, 3] >= 0:
        return "the eyes are swapped in the calibration: its right camera is to the left of the left one"
    return None


def _why_implausible(check: PairCheck, parallel_px: float, *, calibrated: bool) -> str | None:
    """Return the reason why the disparities are impossible, as a sentence; None if they are possible."""
    shift = check.disparities - parallel_px
    middle = float(np.median(shift))
    if abs(middle) < LEAST_DISPARITY_PX and float(np.ptp(shift)) < 4 * LEAST_DISPARITY_PX:
        return f"the two eyes show one and the same picture: points are {middle:.1f} px apart in them"
    behind = float((shift < LEAST_DISPARITY_PX).mean())
    if behind > 0.5:
        return (
            f"the eyes are swapped: points are {-middle:.1f} px further to the right in the right eye's picture than is possible for cameras side by side"
            "; swap the pictures, or check the calibration"
        )
    if behind > 0.02:
        what = "wrong calibration" if calibrated else "uncalibrated eyes that are not parallel"
        return f"some of the tissue would be behind the scope: {behind:.0%} of the points, because of {what}"
    return None


def _why_wrong(found: DepthMap, check: PairCheck, frame: Frame, camera: Camera, parallel_px: float) -> str | None:
    """Return the reason why depth is wrong by more than its intervals, as a sentence, or None.

    Points that were followed to the other eye are an independent measurement. Both measurements have errors, and 10 %
    of their differences are outside of the 90 % intervals of the differences. More are counted as wrong depth if
    chance explains them with a probability of less than 1 %. Intervals are at least those of barely believed depth,
    because the window of a followed point blurs the relief.
    """
    x, y = check.points.astype(int).T
    depth, confidence = found.depth[y, x], found.confidence[y, x]
    known = (confidence >= BELIEVED) & (depth > 0)
    if known.sum() < LEAST_POINTS:
        return None
    disparity = reach_of(frame, camera) / depth[known] + parallel_px
    spread = np.sqrt(variance_px2(confidence[known], frame.width_px, 0.0) + check.error_px**2)
    spread = np.maximum(spread, HALF_BELIEVED_PX * shrink_of(frame.width_px))
    outside = float((np.abs(disparity - check.disparities[known]) > HALF_OF_90 * spread).mean())
    chance = ONE_PERCENT * float(np.sqrt(outside * (1 - outside) / known.sum()))
    if outside - chance <= MOST_OUTSIDE:
        return None
    return f"two ways of matching the eyes contradict each other: {outside:.0%} of the points differ by more than their 90 % interval"


HALF_OF_90 = 1.645
"""Half width of the central 90 % interval of a normal distribution, in standard deviations."""
MOST_OUTSIDE = 0.1
"""Largest accepted share of points at which two ways of matching differ by more than the 90 % interval."""
ONE_PERCENT = 2.33
"""Number of standard deviations that a normally distributed value exceeds with a probability of 1 %."""


def _depth_error(
    variance: NDArray[np.float32], depth: NDArray[np.float32], frame: Frame, camera: Camera
) -> NDArray[np.float32]:
    return np.asarray(np.sqrt(variance) * np.square(depth) / reach_of(frame, camera), np.float32)


def reach_of(frame: Frame, camera: Camera) -> float:
    """Return the product of depth and disparity (focal length times baseline), in mm times pixels; without a right camera in
    baselines times pixels.
    """
    baseline = 1.0 if frame.right_camera is None else -float(frame.right_camera.world_to_camera[0, 3])
    return float(camera.K[0, 0] * baseline)


def _has_company(confidence: NDArray[np.float32], shrink: int) -> NDArray[np.bool_]:
    """Return a bool mask [H, W] of the pixels around which at least half of the pixels are confident (`COMPANY_PX`).

    Wrong matches in occluded areas form islands between pixels that do not match.
    """
    side = 2 * (shrink * COMPANY_PX // 2) + 1
    count = lambda plane: cv2.boxFilter(
        plane, cv2.CV_32F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    confident = (confidence >= BELIEVED).astype(np.uint8)
    return np.asarray(2 * count(confident) >= count(np.ones_like(confident)))


def _tensors_of(pictures: list[NDArray[np.uint8]], device: torch.device) -> list[Tensor]:
    """Copy several pictures to `device` in one transfer."""
    together = tensor_of(np.concatenate([each.ravel() for each in pictures]), device)
    parts = together.split([each.size for each in pictures])
    return [part.reshape(each.shape) for part, each in zip(parts, pictures, strict=True)]


def _off_along_rows(rows: NDArray[np.float64], height: int, width: int, device: torch.device) -> Tensor:
    """Return the possible error of disparities in pixels [H, W] by wrong calibration. A rotation or a scale difference
    between the eyes shifts points along rows as well as across.
    """
    y, x = torch.linspace(-1, 1, height, device=device)[:, None], torch.linspace(-1, 1, width, device=device)
    return torch.hypot(float(rows[1]) * height / width * y, float(rows[2]) * width / height * x)


def with_rows_of_left(right: NDArray[np.uint8], rows: NDArray[np.float64], disparity_px: float) -> NDArray[np.uint8]:
    """Warp the right picture so that points with this disparity are in the same row as in the left one. No change if
    the absolute values of `rows` (as in `PairCheck`) sum up to less than `ROWS_FROM_PX`.
    """
    if np.abs(rows).sum() < ROWS_FROM_PX:
        return right
    height, width = right.shape
    across, down = 2 * rows[1] / width, 2 * rows[2] / height
    move = np.array([[1, 0, 0], [across, 1 + down, rows[0] - rows[1] - rows[2] + across * disparity_px]], np.float64)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(right, move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )
