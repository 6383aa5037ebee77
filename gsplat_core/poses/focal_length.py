"""Focal length of an uncalibrated moving scope, estimated from its pictures, with a range of plausible values.

Key frames are bundle-adjusted once for each of several focal lengths. The focal length with the least robust error is
selected. It is unobservable if the scope hardly turns, because a longer lens with a deeper scene gives the same
pictures. It is also unobservable if the tissue moves by itself. The error is then nearly constant over a wide range,
and the focal length is reported as unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from gsplat_core.geometry.tracks import FeatureTracks, Observations
from gsplat_core.machine import one_thread
from gsplat_core.poses.bundle import Bundle, adjust, errors_px
from gsplat_core.poses.odometry import Trajectory, followed_part, trajectory_of
from gsplat_core.poses.se3 import exp, log
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

SHORTEST, LONGEST = 0.6, 1.6
"""Bounds of the search in units of the picture's longer side, corresponding to fields of view of 80° and 35°."""
CANDIDATES = 8
"""Number of focal lengths tried between the bounds, in equal ratios, before the refinement."""
REFINEMENTS = 4
"""Number of focal lengths that the golden-section search tries after the candidates, two per step."""
NEARLY_AS_WELL = 0.01
"""Relative increase of the error up to which a focal length is as plausible as the best one. Tissue motion alone
changes the error by this much.
"""
WIDEST = 1.5
"""Largest ratio of the plausible range's ends for the focal length to count as known."""
KEY_FRAMES = 20
LEAST_SEEN = 3
"""Fewest key frames in which a point must be observed to be used for the focal length."""
LEAST_POINTS = 50
ROUNDS = 60
OUTLIER_PX = (4.0, 3.0)
"""Reprojection errors above which observations are rejected after the first and the second adjustment, in pixels."""
NEAREST = 0.05
"""Share of the median depth below which a point counts as wrongly triangulated; includes points behind the camera."""


@dataclass(frozen=True)
class FocalLength:
    """Estimate of a focal length in pixels, with its plausible range."""

    assumed_px: float
    best_px: float
    """Focal length in pixels with the least robust reprojection error."""
    range_px: tuple[float, float]
    """Lowest and highest plausible focal length. At a bound of the search the true range may be wider."""
    known: bool
    """True if the range is narrow and away from the bounds of the search."""


def focal_length_of(frames: Iterable[Frame], camera: Camera, found: Trajectory) -> FocalLength | None:
    """Estimate the focal length.

    Args:
        frames: the frames from which `found` was estimated, iterated a second time.
        camera: assumed pinhole camera with one focal length for both axes; its principal point is kept.
        found: trajectory estimated with `camera`.

    Returns:
        The estimate, or None if too few points can be tracked far enough.
    """
    tracks = FeatureTracks()
    for frame in frames:
        tracks.follow(frame.image, followed_part(frame))
    with one_thread():
        start = _start(tracks.observations(LEAST_SEEN), camera, found)
        return None if start is None else _search(start, float(max(camera.width_px, camera.height_px)))


def trajectory_without_calibration(
    read: Callable[[], Iterable[Frame]], camera: Camera
) -> tuple[Trajectory, FocalLength | None]:
    """Estimate a trajectory together with the focal length.

    Args:
        read: returns a new iterator over the frames at each call.
        camera: assumed pinhole camera.

    Returns:
        The trajectory, with the estimated focal length if it is known and with the assumed one
            otherwise, and the estimate or None.
    """
    found = trajectory_of(read(), camera)
    focal = focal_length_of(read(), camera, found)
    if focal is not None and focal.known:
        found = trajectory_of(read(), with_focal_length(camera, focal.best_px))
    return found, focal


def with_focal_length(camera: Camera, focal_px: float) -> Camera:
    """Return a pinhole camera with the same principal point and pose but another focal length in pixels."""
    K = camera.K.copy()
    K[0, 0] = K[1, 1] = focal_px
    return Camera(K, camera.width_px, camera.height_px, camera.world_to_camera)


@dataclass(frozen=True)
class _Try:
    """Candidate focal length: the scene adjusted with it, and the robust cost."""

    bundle: Bundle
    cost: float


def _search(start: Bundle, side_px: float) -> FocalLength:
    spread_px = max(float(errors_px(start).median()), 0.1)

    def tried(focal_px: float, near: _Try) -> _Try:
        bundle = _adjusted(_with_focal(near.bundle, focal_px), spread_px)
        return _Try(bundle, float(torch.log1p((errors_px(bundle) / spread_px).square()).sum()))

    first = _Try(start, math.inf)
    focals = np.geomspace(SHORTEST * side_px, LONGEST * side_px, CANDIDATES)
    tries: dict[float, _Try] = {}
    # Proceed outwards from the assumed focal length. Each adjustment starts from its neighbour's scene.
    for side in (focals[focals >= start.focal_px], focals[focals < start.focal_px][::-1]):
        near = first
        for focal_px in side:
            near = tries[float(focal_px)] = tried(float(focal_px), near)
    _refine(tries, tried)
    best_px = min(tries, key=lambda focal_px: tries[focal_px].cost)
    low, high = _range(tries, best_px)
    inside = bool(low > focals[0] and high < focals[-1])
    return FocalLength(start.focal_px, best_px, (low, high), inside and high / low <= WIDEST)


def _refine(tries: dict[float, _Try], tried: Callable[[float, _Try], _Try]) -> None:
    """Add candidates to `tries` by golden-section search between the neighbours of the best one, on a logarithmic scale."""
    ordered = sorted(tries)
    at = min(range(len(ordered)), key=lambda number: tries[ordered[number]].cost)
    low, high = ordered[max(at - 1, 0)], ordered[min(at + 1, len(ordered) - 1)]
    golden = (math.sqrt(5) - 1) / 2
    for _ in range(REFINEMENTS // 2):
        pair = [low * (high / low) ** share for share in (1 - golden, golden)]
        for focal_px in pair:
            near = min(tries, key=lambda other: abs(math.log(other / focal_px)))
            tries[focal_px] = tried(focal_px, tries[near])
        if tries[pair[0]].cost < tries[pair[1]].cost:
            high = pair[1]
        else:
            low = pair[0]


def _range(tries: dict[float, _Try], best_px: float) -> tuple[float, float]:
    """Return the ends of the range in which the cost is at most `NEARLY_AS_WELL` above the best,
    interpolated between tried values.
    """
    limit = tries[best_px].cost * (1 + NEARLY_AS_WELL)
    ends = []
    for side in (sorted((f for f in tries if f <= best_px), reverse=True), sorted(f for f in tries if f >= best_px)):
        end = side[-1]
        for nearer, farther in pairwise(side):
            if tries[farther].cost > limit:
                share = (limit - tries[nearer].cost) / (tries[farther].cost - tries[nearer].cost)
                end = nearer * (farther / nearer) ** share
                break
        ends.append(float(end))
    return ends[0], ends[1]


def _start(seen: Observations, camera: Camera, found: Trajectory) -> Bundle | None:
    """Triangulate and adjust the key frames for the assumed focal length and reject outliers.
    Returns None with too few points.
    """
    count = len(found.poses)
    keys = np.unique(np.linspace(0, count - 1, min(count, KEY_FRAMES)).round().astype(np.int64))
    seen = seen.of(np.isin(seen.frame, keys))
    seen = seen.of(np.bincount(seen.point)[seen.point] >= LEAST_SEEN) if len(seen.point) else seen
    used, point = np.unique(seen.point, return_inverse=True)
    if len(used) < LEAST_POINTS:
        return None
    focal_px = float(camera.K[0, 0])
    rays = torch.from_numpy((seen.pixels - camera.K[:2, 2]) / focal_px)
    which = torch.from_numpy(np.searchsorted(keys, seen.frame))
    poses = torch.from_numpy(found.poses[keys])
    points = _triangulated(poses, which, torch.from_numpy(point), rays, len(used))
    bundle = Bundle(poses, points, which, torch.from_numpy(point), rays, focal_px)
    for limit_px in OUTLIER_PX:
        bundle = _without_outliers(_adjusted(bundle, 1.0), limit_px)
        if len(bundle.points) < LEAST_POINTS:
            return None
    return _adjusted(bundle, 1.0)


def _adjusted(bundle: Bundle, spread_px: float) -> Bundle:
    fixed = torch.zeros(len(bundle.poses), dtype=torch.bool)
    fixed[0] = True
    return adjust(bundle, fixed=fixed, rounds=ROUNDS, spread_px=spread_px)


def _with_focal(bundle: Bundle, focal_px: float) -> Bundle:
    """Rescale rays, poses and points for another focal length. The result is exact for a flat scene
    far away and otherwise a start value.
    """
    ratio = bundle.focal_px / focal_px
    stretch = torch.tensor([ratio, ratio, 1.0, ratio, ratio, 1.0], dtype=torch.float64)
    return replace(
        bundle, poses=exp(log(bundle.poses) * stretch), points=bundle.points * stretch[:3],
        rays=bundle.rays * ratio, focal_px=focal_px,
    )  # fmt: skip


def _triangulated(poses: Tensor, camera: Tensor, point: Tensor, rays: Tensor, count: int) -> Tensor:
    """Triangulate points [count, 3] by linear least squares (Hartley and Zisserman 2004, section 12.2)."""
    pose = poses[camera]
    rows = pose[:, :2, :3] - rays[:, :, None] * pose[:, 2:3, :3]
    right = rays * pose[:, 2:3, 3] - pose[:, :2, 3]
    normal = torch.zeros(count, 3, 3, dtype=torch.float64)
    normal.index_add_(0, point, rows.transpose(1, 2) @ rows)
    sums = torch.zeros(count, 3, dtype=torch.float64)
    sums.index_add_(0, point, (rows.transpose(1, 2) @ right[:, :, None])[:, :, 0])
    return torch.linalg.solve(normal + 1e-9 * torch.eye(3, dtype=torch.float64), sums)


def _without_outliers(bundle: Bundle, limit_px: float) -> Bundle:
    """Remove observations with large errors or implausible depths, and points left with too few observations."""
    pose = bundle.poses[bundle.camera]
    depth = (pose[:, 2, :3] * bundle.points[bundle.point]).sum(1) + pose[:, 2, 3]
    kept = (errors_px(bundle) < limit_px) & (depth > NEAREST * depth.median())
    kept &= torch.bincount(bundle.point[kept], minlength=len(bundle.points))[bundle.point] >= LEAST_SEEN
    used, point = torch.unique(bundle.point[kept], return_inverse=True)
    return replace(bundle, points=bundle.points[used], camera=bundle.camera[kept], point=point, rays=bundle.rays[kept])
