"""Depth by parallax of a moving scope from known poses.

The depth of a picture is estimated from other pictures. Tracked corners are first checked against the poses. For given
poses, the position of a point in another picture is linear in its inverse depth w (triangulation; Hartley and Zisserman
2004, section 12.2). A corner therefore gives a least-squares w and a residual that no w removes. The residual is small
if the poses are right.

The corners also give the range of distances. A plane sweep (Collins 1996) over it gives matching costs, and semi-global
matching (Hirschmüller 2008) selects distances. Each pixel's confidence reflects how well and how uniquely the views
match. Deforming or textureless tissue gets no confidence, and its depth is a smooth extrapolation. Frames of a stream
are compared with earlier key frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.depth.maps import UNCONFIRMED, DepthMap, Estimator, RecordingDepth, ReducedDepth, agree, doubted
from gsplat_core.geometry.tracks import followed
from gsplat_core.machine import usable_cores
from gsplat_core.ops.plane_sweep import WINDOW_PX, MatchingCosts, select_planes, sweep_planes
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, PARALLAX, Frame


@dataclass(frozen=True)
class View:
    """Grey picture with its tissue mask and its camera, including the pose."""

    grey: NDArray[np.uint8]
    """Grey levels, uint8 [H, W]."""
    tissue: NDArray[np.uint8]
    """Mask uint8 [H, W]: 1 on tissue that can be tracked, 0 elsewhere."""
    camera: Camera


def matching_costs(reference: View, others: Sequence[View], inverse_depths: NDArray[np.float64]) -> MatchingCosts:
    """Compute the matching costs of inverse depths by a plane sweep.

    Args:
        reference: picture whose depth is wanted.
        others: views to compare with, of the size of the reference.
        inverse_depths: float64 [D], one per label.

    Returns:
        Costs, and numbers of agreeing views.
    """
    homographies = np.stack([_plane_homographies(reference.camera, view.camera, inverse_depths) for view in others], 1)
    return sweep_planes(
        torch.from_numpy(np.ascontiguousarray(reference.grey)),
        torch.from_numpy(_whole_patches(reference.tissue)),
        torch.from_numpy(np.stack([view.grey for view in others])),
        torch.from_numpy(np.stack([_whole_patches(view.tissue) for view in others])),
        torch.from_numpy(homographies),
    )


def _plane_homographies(reference: Camera, view: Camera, inverse_depths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the homographies [D, 3, 3] from `reference` to `view` for fronto-parallel planes, in OpenCV pixel
    coordinates (pixel centres at integers).
    """
    between = view.world_to_camera @ np.linalg.inv(reference.world_to_camera)
    centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    to_view, to_rays = np.linalg.inv(centre) @ view.K, np.linalg.inv(reference.K) @ centre
    shift = np.outer(to_view @ between[:3, 3], [0, 0, 1] @ to_rays)
    return np.asarray(to_view @ between[:3, :3] @ to_rays + np.multiply.outer(inverse_depths, shift))


def _whole_patches(tissue: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return uint8 [H, W], 1 where the whole correlation window around a pixel is tissue, else 0."""
    return np.asarray(cv2.erode((tissue != 0).astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX), np.uint8)), np.uint8)


POINTS = 400
"""Largest number of tracked corners."""
APART_PX = 5
"""Smallest distance between corners in pixels."""
RETURNS_PX = 0.5
"""Largest accepted error of a point tracked forward and back, in pixels."""
FEWEST_POINTS = 24
"""Fewest tracked corners that a view must have in common with the reference picture to be used, and that must agree with the poses."""
TRACK_ERROR_PX = 0.5
"""Standard deviation of a tracked position in pixels."""
RELIEF = 0.5
"""Prior standard deviation of a point's inverse depth, relative to the inverse depth of the best-fitting plane."""
LARGEST_RELIEF = 4.0
"""Largest ratio between a point's inverse depth and that of the plane, in either direction."""
LEAST_PARALLAX_PX = 1.5
"""Smallest sufficient `Parallax.parallax_px`; with less, depth is noise."""
MOST_LEFT_PX, MOST_LEFT = 1.0, 0.25
"""Limits of a view's median residual, in pixels and as a share of its parallax. A view that exceeds both contradicts its pose."""
POSE_ERROR_PX = 0.6
"""Residual of static tissue in pixels, from errors of poses and tracking."""
FEWEST_AGREEING = 0.6
"""Smallest share of the views whose poses must explain the image motion; also of the corners, where fewer than `FEWEST_POINTS` agree."""
TOO_FEW = "too few points of the tissue can be tracked"
"""Rejection reason if fewer than `FEWEST_POINTS` corners can be tracked, or agree although most of them do."""
CONTRADICTED = "the poses do not explain how the pictures move: they are wrong, or the tissue itself moves"
"""Rejection reason if fewer than `FEWEST_AGREEING` of the views, or of the corners where they are few, agree with the poses."""
ROUNDS = 6
"""Rounds of iteratively reweighted least squares, which reduces the weight of corners on moving objects."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Parallax:
    """Depth of tracked corners and consistency of the poses for one picture."""

    inverse_depths: Array
    """Inverse depths of the corners that agree with the poses, [n]."""
    plane: float
    """Inverse depth of the fronto-parallel plane that fits the corners best."""
    views: tuple[int, ...]
    """Indices of the views that agree with their poses."""
    parallax_px: float
    """Median parallax of the tracked corners in pixels, in the view in which it is largest."""
    own_motion: float
    """Median residual that no depth explains, as a share of the parallax: the tissue's own motion. Motion along the
    parallax direction is mistaken for depth, so the relative depth error is about this share, or up to twice as large.
    """


def explained_by_poses(reference: View, others: Sequence[View]) -> Parallax | str:
    """Check poses with corners tracked from `reference` to the other views.

    Returns:
        The corners' depths and the agreeing views, or the reason for rejection as a sentence.
    """
    corners = _corners(reference)
    tracks = [_followed(reference, view, corners) for view in others]
    usable = [number for number, (_, found) in enumerate(tracks) if found.sum() >= FEWEST_POINTS]
    if not usable:
        return TOO_FEW
    terms = [_terms(corners, tracks[number][0], reference.camera, others[number].camera) for number in usable]
    c, d = (np.stack(each) for each in zip(*terms, strict=True))
    seen = np.stack([tracks[number][1] for number in usable])
    focal = float(reference.camera.K[0, 0])
    kept = list(range(len(usable)))
    while True:
        plane = _plane(c[kept], d[kept], seen[kept], focal)
        moved = _medians(focal * abs(plane) * np.linalg.norm(c[kept], axis=2), seen[kept])
        shown = _medians(focal * np.linalg.norm(d[kept], axis=2), seen[kept])
        if moved.max() < LEAST_PARALLAX_PX and shown.max() < 2 * LEAST_PARALLAX_PX:
            return "the poses move but the pictures hardly do: there is no parallax to estimate depth from"
        inverse = _relief(c[kept], d[kept], seen[kept], focal, max(plane, 1e-12))
        off = _medians(_off_px(c[kept], d[kept], focal, inverse), seen[kept])
        excess = off / np.maximum(MOST_LEFT_PX, MOST_LEFT * moved)
        worst = int(excess.argmax())
        if plane > 0 and excess[worst] <= 1:
            break
        kept.pop(worst)
        if len(kept) < max(1, FEWEST_AGREEING * len(usable)):
            return CONTRADICTED
    if moved.max() < LEAST_PARALLAX_PX:
        return "there is too little parallax to estimate depth from"
    agree = (seen[kept] & (_off_px(c[kept], d[kept], focal, inverse) < 3 * MOST_LEFT_PX)).any(0)
    if agree.sum() < FEWEST_POINTS:
        return TOO_FEW if agree.sum() >= FEWEST_AGREEING * seen[kept].any(0).sum() else CONTRADICTED
    own = np.sqrt(np.maximum(off**2 - POSE_ERROR_PX**2, 0)) / np.maximum(moved, LEAST_PARALLAX_PX)
    views = tuple(usable[number] for number in kept)
    return Parallax(inverse[agree], plane, views, float(moved.max()), float(np.median(own)))


def _corners(view: View) -> NDArray[np.float32]:
    """Return trackable corners of the tissue in OpenCV pixel coordinates [n, 2]."""
    found = cv2.goodFeaturesToTrack(
        view.grey, POINTS, 0.005, APART_PX, mask=cv2.erode(view.tissue, np.ones((9, 9), np.uint8))
    )
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)


def _followed(
    reference: View, view: View, corners: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the position of each corner of `reference` in `view` [n, 2], and a bool mask [n], True where it was found on tissue."""
    there, misses_px = followed(reference.grey, view.grey, corners, window_px=15, levels=4)
    height, width = view.tissue.shape
    column, row = (
        np.clip(np.nan_to_num(there[:, axis]), 0, size - 1).astype(int) for axis, size in ((0, width), (1, height))
    )
    return there, (misses_px < RETURNS_PX) & (view.tissue[row, column] > 0)


def _terms(
    corners: NDArray[np.float32], target: NDArray[np.float32], before: Camera, after: Camera
) -> tuple[Array, Array]:
    """Return c and d [n, 2] of the triangulation equation w c = d for the inverse depth w of each corner.

    The residual d - w c is an image distance in units of the focal length.
    """
    between = after.world_to_camera @ np.linalg.inv(before.world_to_camera)
    first, second = _normalised(corners, before), _normalised(target, after)
    ray = np.concatenate([first, np.ones((len(first), 1))], 1) @ between[:3, :3].T
    return second * between[2, 3] - between[:2, 3], ray[:, :2] - second * ray[:, 2:]


def _normalised(pixels: NDArray[np.float32], camera: Camera) -> Array:
    """Convert OpenCV pixel coordinates to rays (x / z, y / z) in camera coordinates."""
    return np.asarray((pixels.astype(np.float64) + 0.5 - camera.K[:2, 2]) / np.diag(camera.K)[:2])


def _medians(values: Array, seen: NDArray[np.bool_]) -> Array:
    """Return the median of values [views, points] over the tracked points of each view, [views]."""
    return np.array([float(np.median(row[mask])) for row, mask in zip(values, seen, strict=True)])


def _plane(c: Array, d: Array, seen: NDArray[np.bool_], focal: float) -> float:
    """Return the common inverse depth w of all points (a fronto-parallel plane) that fits w c = d robustly.

    c and d [views, points, 2] are those of `_terms`.
    """
    weight, inverse = seen.astype(np.float64), 0.0
    for _ in range(ROUNDS):
        inverse = float((weight * (c * d).sum(-1)).sum() / max((weight * (c * c).sum(-1)).sum(), 1e-20))
        weight = seen * _agreement(c, d, focal, np.full(c.shape[1], inverse))
    return inverse


def _relief(c: Array, d: Array, seen: NDArray[np.bool_], focal: float, plane: float) -> Array:
    """Return each point's inverse depth [points] by robust least squares over all views, with the plane as prior mean."""
    prior = 1 / (RELIEF * plane) ** 2
    inverse = np.full(c.shape[1], plane)
    for _ in range(ROUNDS):
        weight = seen * _agreement(c, d, focal, inverse) * (focal / TRACK_ERROR_PX) ** 2
        evidence, information = (weight * (c * d).sum(-1)).sum(0), (weight * (c * c).sum(-1)).sum(0)
        inverse = np.clip(
            (evidence + prior * plane) / (information + prior), plane / LARGEST_RELIEF, plane * LARGEST_RELIEF
        )
    return np.asarray(inverse)


def _agreement(c: Array, d: Array, focal: float, inverse: Array) -> Array:
    """Return weights [views, points] of iteratively reweighted least squares: 1 up to the residual `TRACK_ERROR_PX`, and inverse
    to larger residuals (Huber).
    """
    return np.asarray(TRACK_ERROR_PX / np.maximum(_off_px(c, d, focal, inverse), TRACK_ERROR_PX))


def _off_px(c: Array, d: Array, focal: float, inverse: Array) -> Array:
    return np.asarray(focal * np.linalg.norm(d - inverse[..., None] * c, axis=-1))


WORKING_PX = 320
"""Longest side in pixels of the compared pictures when there is no real-time limit."""
MOST_VIEWS = 6
"""Largest number of other pictures with which one picture is compared."""
SHORTEST_BASELINE = 0.1
"""Baseline below which a view is ignored because it adds noise, as a share of the longest baseline of all views."""
WIDEST_TURN = 0.7
"""Smallest cosine between the optical axes of two cameras that are compared."""
LABEL_PX = 0.75
"""Parallax between neighbouring distances of the sweep, in pixels of the view with the most parallax."""
LABELS = 24, 96
"""Smallest and largest number of distances that a plane sweep tests."""
MARGIN = 1.6
"""Factor by which the plane sweep extends the range of the tracked corners' distances at both ends."""
WORST_COST, BEST_COST = 0.35, 0.15
"""Mean matching cost ((1 - ZNCC) / 2) at which the confidence is 0, and below which it is not reduced."""
UNIQUE = 0.2
"""Relative margin between the best matching cost and that of any other depth from which the confidence is not reduced."""
SMALLEST_PATCH = 0.0014
"""Smallest connected patch of confident depth, as a share of the picture; smaller ones are chance matches."""
MOST_OWN_MOTION = 0.06
"""Tissue motion as a share of the parallax from which on depth has confidence 0. The confidence is 1 up to half
this share and decreases linearly between the two.
"""
DEFORMS = "the tissue moves too much relative to the scope for depth by parallax"
"""Reason for rejecting a map without any confident depth, which moving tissue usually causes."""
FILLED = 0.2
"""Largest confidence of depth that is extrapolated from its surroundings, and confidence of small isolated patches."""


def view_of(frame: Frame, camera: Camera, longest_px: int = WORKING_PX) -> View:
    """Reduce a frame so that no side is longer than `longest_px`. `camera` is the frame's camera with its pose."""
    height, width = frame.image.shape[:2]
    scale = min(1.0, longest_px / max(height, width))
    small = camera.scaled(scale)
    size = small.width_px, small.height_px
    grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
    tissue = np.ones((height, width), np.uint8)
    for mask in (frame.mask, frame.loss_mask):
        if mask is not None:
            tissue &= (mask != 0).astype(np.uint8)
    return View(
        np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8),
        np.asarray(cv2.resize(tissue, size, interpolation=cv2.INTER_NEAREST), np.uint8),
        small,
    )


def chosen_views(reference: View, candidates: Sequence[View]) -> list[View]:
    """Select at most `MOST_VIEWS` candidates facing the same way, evenly spread from the shortest
    useful baseline to the longest.
    """
    axis = reference.camera.world_to_camera[2, :3]
    position = reference.camera.position
    facing = [view for view in candidates if float(axis @ view.camera.world_to_camera[2, :3]) >= WIDEST_TURN]
    far = [float(np.linalg.norm(view.camera.position - position)) for view in facing]
    longest = max(far, default=0.0)
    useful = sorted(
        (each, number) for number, each in enumerate(far) if each > 0 and each >= SHORTEST_BASELINE * longest
    )
    if not useful:
        return []
    picked = np.linspace(0, len(useful) - 1, min(MOST_VIEWS, len(useful))).round().astype(int).tolist()
    return [facing[useful[index][1]] for index in picked]


def depth_of_view(reference: View, candidates: Sequence[View], size: tuple[int, int]) -> DepthMap:
    """Estimate the depth of a picture.

    Args:
        reference: picture whose depth is wanted.
        candidates: other pictures with poses.
        size: height and width of the result.

    Returns:
        Depth in the unit of the poses. The map is rejected if the poses contradict the pictures. If the tissue itself
        moves too much, all confidences are low and the depth is only a rough start value.
    """
    others = chosen_views(reference, candidates)
    if not others:
        return doubted(size, PARALLAX, "the scope does not move")
    found = explained_by_poses(reference, others)
    if isinstance(found, str):
        return doubted(size, PARALLAX, found)
    inverse_depths = _distances(found)
    planes = select_planes(matching_costs(reference, [others[number] for number in found.views], inverse_depths))
    labels, unique, costs, agreeing = (each.numpy() for each in planes)
    inverse = np.interp(labels, np.arange(len(inverse_depths)), inverse_depths).astype(np.float32)
    confidence = np.minimum((WORST_COST - costs) / (WORST_COST - BEST_COST), unique / UNIQUE)
    # Exclude the first and last distances, which also collect all pixels beyond the swept range.
    nearest = np.rint(labels)
    inside = (nearest > 0) & (nearest < len(inverse_depths) - 1)
    confidence = np.clip(confidence, 0, 1) * float(np.clip(2 - 2 * found.own_motion / MOST_OWN_MOTION, 0, 1))
    confidence = confidence * inside * (reference.tissue != 0) * (agreeing >= min(2, len(found.views)))
    confidence = _without_speckles(labels, confidence.astype(np.float32))
    return _at_full_size(*_filled(inverse, confidence, found), size)


def _distances(found: Parallax) -> NDArray[np.float64]:
    """Return evenly spaced inverse depths over the tissue's range; parallax is linear in inverse depth."""
    low, high = np.percentile(found.inverse_depths, [2, 98])
    low, high = low / MARGIN, high * MARGIN
    span_px = found.parallax_px * (high - low) / found.plane
    return np.linspace(low, high, int(np.clip(round(span_px / LABEL_PX), *LABELS)))


def _without_speckles(labels: NDArray[np.float32], confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """Reduce the confidence of small patches of depth that differ from their surroundings."""
    steps = np.where(confidence >= BELIEVED, labels * 16, -16).astype(np.int16)
    cv2.filterSpeckles(steps, -16, round(SMALLEST_PATCH * steps.size), 24)
    return np.where((steps == -16) & (confidence >= BELIEVED), np.float32(FILLED), confidence)


def _filled(
    inverse: NDArray[np.float32], confidence: NDArray[np.float32], found: Parallax
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Replace unconfident inverse depth by a smooth continuation of the confident values around it, and far from them by the
    fitted plane. The confidence of replaced values becomes at most `FILLED`.

    Returns:
        Inverse depth and confidence, both [h, w].
    """
    height, width = inverse.shape
    believed = (confidence >= BELIEVED).astype(np.float32)
    smooth = np.full_like(inverse, found.plane)
    for sigma in (max(height, width) / share for share in (10, 20, 40, 80, 160)):
        weight = cv2.GaussianBlur(believed, (0, 0), sigma)
        near = cv2.GaussianBlur(inverse * believed, (0, 0), sigma)
        smooth = (near + np.float32(0.05) * smooth) / (weight + np.float32(0.05))
    return np.where(believed > 0, inverse, smooth), np.where(
        believed > 0, confidence, np.minimum(confidence, np.float32(FILLED))
    )


def _at_full_size(inverse: NDArray[np.float32], confidence: NDArray[np.float32], size: tuple[int, int]) -> DepthMap:
    full = size[1], size[0]
    depth = 1 / np.asarray(cv2.resize(inverse, full, interpolation=cv2.INTER_LINEAR), np.float32)
    sure = np.asarray(cv2.resize(confidence, full, interpolation=cv2.INTER_LINEAR), np.float32)
    return DepthMap(depth.astype(np.float32), sure, PARALLAX, metric=False)


STREAM_PX = 160
"""Longest side of the compared pictures in pixels; smaller than offline to keep up with the stream."""
MOST_KEY_FRAMES = 8
"""Largest number of key frames of a stream. When it is exceeded, the older of the two key frames with the closest cameras is removed.
"""
MOST_OFFLINE = 32
"""Largest number of frames of a complete recording that get depth, spread evenly."""
LONGEST_S = 3.0
"""Largest time difference in seconds between frames compared for parallax, limited because tissue deforms."""
EVERY_S = 0.2
"""Time in seconds from a depth map to the next attempt. From then on every frame is tried until one gets depth."""


class ParallaxDepth(Estimator):
    """Depth estimator by parallax for streams, with bounded memory and time per frame.

    Depth is estimated every `EVERY_S` and not for the frames between. A depth map is returned only if it agrees with
    the previous one (`agree`). Frames without a pose, and cameras other than pinholes, get no depth.
    """

    origin = PARALLAX
    needs = "pose"
    evidence = "the given poses"

    def __init__(self) -> None:
        self._kept: list[tuple[float, View]] = []
        self._found_s: float | None = None
        self._last: ReducedDepth | None = None
        """Reduced copy of the last depth map, estimated at time `_found_s`, which has to confirm the next one."""

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """Estimate the depth of a frame by parallax against the key frames; None for a frame without pose, for other cameras
        than pinholes, and within `EVERY_S` seconds of the last map.
        """
        if frame.new_scene is not None:
            self._kept, self._found_s, self._last = [], None, None
        if frame.pose is None or camera.model != "pinhole":
            return None
        now_s = frame.time_s
        self._kept = [(time_s, view) for time_s, view in self._kept if 0 <= now_s - time_s <= LONGEST_S]
        due = self._found_s is None or not 0 <= now_s - self._found_s < EVERY_S
        if self._kept and not due and not self._is_elsewhere(camera):
            return None
        view = view_of(frame, camera, STREAM_PX)
        others = [each for _, each in self._kept if each.grey.shape == view.grey.shape]
        found = None
        if due and any(_apart(each, view) > 0 for each in others):
            found = depth_of_view(view, others, (frame.height_px, frame.width_px))
            if found.doubt is None and not np.any(found.believed):
                found = doubted(found.depth.shape, found.origin, DEFORMS)
            if found.doubt is None:
                found = self._confirmed(found, camera, now_s)
        if self._is_elsewhere(camera):
            self._keep(now_s, view)
        return found

    def of_recording(self, frames: Sequence[Frame], cameras: Sequence[Camera]) -> RecordingDepth:
        """Estimate depth for key frames, assuming static tissue; unchanged frames if the camera does not move or is not a
        pinhole, or if any frame has depth.
        """
        moves = any(not np.array_equal(camera.world_to_camera, cameras[0].world_to_camera) for camera in cameras)
        if not moves or cameras[0].model != "pinhole" or any(frame.depth is not None for frame in frames):
            return RecordingDepth(list(frames), {})
        return _confirmed(*_compared(frames, cameras), cameras)

    def _confirmed(self, found: DepthMap, camera: Camera, now_s: float) -> DepthMap | None:
        """Return the depth if it agrees with the previous depth map, a rejected map if not, or None for the first one."""
        is_first = self._found_s is None or not 0 <= now_s - self._found_s <= LONGEST_S
        before, self._last = self._last, ReducedDepth.of(found.depth, found.confidence, camera)
        self._found_s = now_s
        if is_first or before is None:
            return None
        return found if agree(before, self._last) else doubted(found.depth.shape, found.origin, UNCONFIRMED)

    def _is_elsewhere(self, camera: Camera) -> bool:
        """Return True if the scope is farther from every key frame than the closest two key frames are from each other.
        With fewer than `MOST_KEY_FRAMES` key frames, any new position counts.
        """
        if not self._kept:
            return True
        nearest = min(float(np.linalg.norm(view.camera.position - camera.position)) for _, view in self._kept)
        return nearest > 0 and (len(self._kept) < MOST_KEY_FRAMES or nearest > min(self._gaps()))

    def _keep(self, now_s: float, view: View) -> None:
        self._kept.append((now_s, view))
        if len(self._kept) > MOST_KEY_FRAMES:
            # argmin returns the older of the two closest key frames.
            self._kept.pop(int(np.argmin(self._gaps())))

    def _gaps(self) -> list[float]:
        """Return the distance of each key frame's camera to the nearest camera of another key frame."""
        views = [view for _, view in self._kept]
        return [min(_apart(one, other) for other in views if other is not one) for one in views]


def _apart(one: View, other: View) -> float:
    return float(np.linalg.norm(one.camera.position - other.camera.position))


def _confirmed(frames: list[Frame], doubts: Counter[str], cameras: Sequence[Camera]) -> RecordingDepth:
    """Keep the depth of all frames if a neighbour confirms at least half of the depth maps, else of none.

    One decision is made for the whole recording, because frames with and without depth would start at different
    distances. `agree` compares two depth maps. Reasons are added to `doubts`.
    """
    numbers = [number for number, frame in enumerate(frames) if frame.depth is not None]
    reduced = [
        ReducedDepth.of(depth, frames[number].depth_confidence, cameras[number])
        for number in numbers
        if (depth := frames[number].depth) is not None
    ]
    confirmed: set[int] = set()
    for (one, first), (other, second) in pairwise(zip(numbers, reduced, strict=True)):
        if agree(first, second):
            confirmed |= {one, other}
    if 2 * len(confirmed) < len(numbers):
        for number in numbers:
            frames[number] = frames[number].with_fields(depth=None, depth_confidence=None, depth_origin=None)
            doubts[UNCONFIRMED] += 1
    return RecordingDepth(frames, doubts, at_rest=True)


def _compared(frames: Sequence[Frame], cameras: Sequence[Camera]) -> tuple[list[Frame], Counter[str]]:
    """Estimate depth for key frames assuming static tissue. Returns all frames and the reasons for rejected depth."""
    given, doubts = list(frames), Counter[str]()
    views = [view_of(frame, camera) for frame, camera in zip(frames, cameras, strict=True)]
    count = min(MOST_OFFLINE, len(frames))
    chosen: list[int] = np.linspace(0, len(frames) - 1, count).round().astype(int).tolist()

    def depth_at(number: int) -> DepthMap:
        frame = frames[number]
        near = [
            view for view, other in zip(views, frames, strict=True)
            if other is not frame and abs(other.time_s - frame.time_s) <= LONGEST_S
        ]  # fmt: skip
        return depth_of_view(views[number], near, frame.image.shape[:2])

    with ThreadPoolExecutor(usable_cores(), thread_name_prefix="parallax") as pool:
        for number, found in zip(chosen, pool.map(depth_at, chosen), strict=True):
            if found.doubt is not None:
                doubts[found.doubt] += 1
                continue
            if not np.any(found.believed):
                doubts[DEFORMS] += 1
            given[number] = _with(frames[number], found)
    return given, doubts


def _with(frame: Frame, found: DepthMap) -> Frame:
    return frame.with_fields(depth=found.depth, depth_confidence=found.confidence, depth_origin=found.origin)
