"""Bounded map of tissue points and key frames for live odometry, adjusted a little with every frame.

Earlier key frames are recognised in a picture by a predicted pose or, if the pose is unknown, by appearance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.geometry.stream_tracks import Numbers, SmallPicture, found_again
from gsplat_core.geometry.tracks import Points
from gsplat_core.poses.bundle import Bundle, placed
from gsplat_core.poses.bundle import adjust as adjusted
from gsplat_core.poses.se3 import exp, inverse, log

WINDOW = 12
"""Number of newest key frames whose poses are adjusted."""
ANCHORS = 5
"""Number of earlier key frames sharing points with the window that are kept fixed."""
MOST_KEY_FRAMES = 40
"""Largest number of key frames. Beyond it, the key frame whose camera is nearest to that of another one is removed. The
first key frame and the newest `WINDOW` are kept.
"""
NEIGHBOURS = 5
"""Number of known points around a new point whose median depth initialises it."""
MOST_SIGHTINGS = 1500
"""Number of observations whose adjustment takes one step; fewer are adjusted in several, up to `MOST_ROUNDS`."""
MOST_ROUNDS = 5
"""Largest number of steps of an adjustment."""


@dataclass
class KeyFrame:
    """Key frame with its pose and its observations of map points."""

    pose: Tensor
    """World-to-camera pose [4, 4]."""
    numbers: Numbers
    """Numbers of the observed points, ascending."""
    pixels: Points
    picture: SmallPicture
    rays: NDArray[np.float64]
    features: Any = None
    """ORB corners and descriptors, computed on first use."""

    @property
    def position(self) -> NDArray[np.float64]:
        """Camera centre in the world, [3]."""
        return position_of(self.pose)


class LocalMap:
    """Points and key frames of one continuous piece of a stream. All values are float64 on the CPU."""

    def __init__(self) -> None:
        self.keys: list[KeyFrame] = []
        """Key frames in temporal order."""
        self._numbers: Numbers = np.zeros(0, np.int64)
        self._points = torch.zeros(0, 3, dtype=torch.float64)

    def __len__(self) -> int:
        return len(self._numbers)

    def points(self, numbers: Numbers) -> Tensor:
        """Return the world positions [N, 3] of points in the map."""
        return self._points[torch.from_numpy(np.searchsorted(self._numbers, numbers))]

    def knows(self, numbers: Numbers) -> NDArray[np.bool_]:
        """Return which of the points are in the map, bool [N]."""
        return np.isin(numbers, self._numbers)

    def add_points(self, numbers: Numbers, places: Tensor) -> None:
        """Add points [N] at world positions [N, 3]. Their numbers must be larger than all earlier ones."""
        self._numbers = np.concatenate([self._numbers, numbers])
        self._points = torch.cat([self._points, places])

    def add_key(self, key: KeyFrame) -> None:
        """Append the newest key frame, evicting one if the map is full."""
        self.keys.append(key)
        if len(self.keys) > MOST_KEY_FRAMES:
            # Keep the window, which is adjusted, and the first key frame, which fixes the world coordinates.
            places = np.stack([key.position for key in self.keys[:-WINDOW]])
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(len(places), np.inf))
            self.keys.pop(1 + int(np.argmin(apart[1:].min(1))))
            self._forget()

    def depth_around(
        self, pose: Tensor, rays: NDArray[np.float64], numbers: Numbers, seen: NDArray[np.float64]
    ) -> Tensor:
        """Return the depth of new points as the median depth of the known points nearest to them in the picture.

        Args:
            pose: world-to-camera pose [4, 4] of the picture.
            rays: rays of the new points [N, 2].
            numbers: numbers [K] of known points.
            seen: rays of the known points [K, 2].

        Returns:
            float64 [N].
        """
        local = self.points(numbers) @ pose[:3, :3].T + pose[:3, 3]
        apart = torch.cdist(torch.from_numpy(rays), torch.from_numpy(seen))
        nearest = apart.topk(min(NEIGHBOURS, len(numbers)), largest=False).indices
        return local[:, 2][nearest].median(1).values

    def brought_back(self, key: KeyFrame, after: Tensor, scale: float) -> None:
        """Correct the drift accumulated since an earlier key frame that was recognised again.

        The newest key frame and its points get the full correction, those between get a share that grows linearly.

        Args:
            key: the recognised key frame.
            after: rigid correction [4, 4] about the world's origin, applied after scaling.
            scale: scale correction.
        """
        start = next(index for index, each in enumerate(self.keys) if each is key)
        newer = self.keys[start + 1 :]
        moved = np.isin(self._numbers, np.concatenate([each.numbers for each in self.keys[: start + 1]]))
        twist = log(after)
        for number, each in enumerate(newer, start=1):
            share = number / len(newer)
            step, factor = exp(share * twist), scale**share
            points = torch.from_numpy(np.isin(self._numbers, each.numbers) & ~moved)
            moved |= points.numpy()
            self._points[points] = factor * self._points[points] @ step[:3, :3].T + step[:3, 3]
            each.pose = scaled(each.pose, factor) @ inverse(step)

    def earlier(self, position: NDArray[np.float64], most: int) -> list[KeyFrame]:
        """Return the `most` key frames before the window that are nearest to a position [3], nearest first."""
        before = self.keys[:-WINDOW]
        order = np.argsort([float(np.linalg.norm(key.position - position)) for key in before], kind="stable")
        return [before[index] for index in order[:most]]

    def adjust(self) -> None:
        """Run a few steps of bundle adjustment over the newest key frames and their anchors. The anchors are fixed, or
        the earliest key frame if there are none. With fewer than two anchors the scale is free, so the median point
        depth of the earliest key frame is kept as well.
        """
        window = self.keys[-WINDOW:]
        anchors = self._anchors(window)
        chosen = [*anchors, *window]
        if len(chosen) < 2:
            return
        numbers = np.concatenate([key.numbers for key in chosen])
        camera = np.repeat(np.arange(len(chosen)), [len(key.numbers) for key in chosen])
        rays = np.concatenate([key.rays for key in chosen])
        used, point, times = np.unique(numbers, return_inverse=True, return_counts=True)
        often = times[point] >= 2
        used, point = np.unique(numbers[often], return_inverse=True)
        if len(used) < 12:
            return
        where = torch.from_numpy(np.searchsorted(self._numbers, used))
        bundle = Bundle(
            torch.stack([key.pose for key in chosen]), self._points[where], torch.from_numpy(camera[often]), torch.from_numpy(point),
            torch.from_numpy(rays[often]), float(chosen[0].picture.camera.K[0, 0]),
        )  # fmt: skip
        fixed = torch.zeros(len(chosen), dtype=torch.bool)
        fixed[: max(1, len(anchors))] = True
        rounds = max(1, min(MOST_ROUNDS, MOST_SIGHTINGS // max(1, int(often.sum()))))
        before = self._depth_of(chosen[0])
        bundle = adjusted(bundle, fixed=fixed, rounds=rounds)
        self._points[where] = bundle.points
        for key, pose in zip(chosen, bundle.poses, strict=True):
            key.pose = pose
        if len(anchors) < 2:
            self._rescale(chosen[0], float(before / self._depth_of(chosen[0])))

    def _anchors(self, window: list[KeyFrame]) -> list[KeyFrame]:
        """Return the key frames before the window that share the most points with it."""
        seen = np.unique(np.concatenate([key.numbers for key in window]))
        before = self.keys[: -len(window)]
        shared = [int(np.isin(key.numbers, seen).sum()) for key in before]
        best = sorted(range(len(before)), key=lambda index: (-shared[index], -index))[:ANCHORS]
        return [before[index] for index in sorted(best) if shared[index] >= 6]

    def _depth_of(self, key: KeyFrame) -> Tensor:
        """Return the median depth of a key frame's points."""
        local = self.points(key.numbers) @ key.pose[2, :3] + key.pose[2, 3]
        return local.median()

    def _rescale(self, about: KeyFrame, factor: float) -> None:
        """Scale all lengths about the position of a key frame. No effect for a factor outside 0.1 to 10."""
        if not 0.1 < factor < 10:
            return
        centre = torch.from_numpy(about.position)
        self._points = centre + factor * (self._points - centre)
        for key in self.keys:
            position = centre + factor * (torch.from_numpy(key.position) - centre)
            key.pose = key.pose.clone()
            key.pose[:3, 3] = -key.pose[:3, :3] @ position

    def _forget(self) -> None:
        """Remove points that no key frame observes any more."""
        seen = np.unique(np.concatenate([key.numbers for key in self.keys]))
        kept = np.isin(self._numbers, seen)
        self._numbers, self._points = self._numbers[kept], self._points[torch.from_numpy(kept)]


def unprojected(pose: Tensor, rays: NDArray[np.float64], depth: Tensor) -> Tensor:
    """Return the world positions [N, 3] of points seen along `rays` [N, 2] at `depth` [N] by a
    camera with `pose` [4, 4].
    """
    local = torch.cat([torch.from_numpy(rays), torch.ones(len(rays), 1, dtype=torch.float64)], 1) * depth[:, None]
    return (local - pose[:3, 3]) @ pose[:3, :3]


def scaled(pose: Tensor, factor: float) -> Tensor:
    """Return the pose [4, 4] in a world whose lengths are multiplied by a factor."""
    pose = pose.clone()
    pose[:3, 3] *= factor
    return pose


def position_of(pose: Tensor) -> NDArray[np.float64]:
    """Return the camera centre [3] of a pose."""
    return np.asarray((-pose[:3, :3].T @ pose[:3, 3]).numpy())


FEWEST_POINTS = 20
"""Fewest points of a key frame that must be searched, found and agree on a pose for it to be recognised."""
SHOWN = 0.4
"""Share of a key frame's points that must be inside the picture for it to be searched."""
FOUND = 0.3
"""Share of the searched points of a key frame that must be found for it to be recognised."""
AGREE, AGREE_PX = 0.5, 4.0
"""Share of the found points that must agree on a pose, and their largest reprojection error in pixels."""
FEATURES = 400
"""Largest number of ORB features per picture."""
CLEARER = 0.8
"""Largest ratio of the best to the second-best descriptor distance of a match (Lowe's ratio test)."""
FEWEST_MATCHES, MATCH_PX = 12, 8.0
"""Fewest RANSAC inliers and their largest reprojection error in pixels. The error is large because
their depth is interpolated from known points.
"""
TRIES = 100
"""Number of RANSAC iterations for the pose from feature matches."""
Pose = NDArray[np.float64]


@dataclass(frozen=True)
class Recognised:
    """Key frame recognised in a picture."""

    key: KeyFrame
    places: LocalMap
    pose: Pose
    """World-to-camera pose [4, 4] of the picture, estimated from the recognised points alone."""
    numbers: Numbers
    """Numbers of the points found, ascending."""
    pixels: Points
    """Pixel positions of the recognised points, [N, 2]."""


def seen_again(
    key: KeyFrame, places: LocalMap, picture: SmallPicture, pose: Pose, followed: Numbers | None = None
) -> Recognised | None:
    """Search the points of a key frame in a picture with a predicted pose.

    Args:
        key: key frame.
        places: map that contains the key frame.
        picture: picture to search.
        pose: predicted world-to-camera pose [4, 4].
        followed: points already tracked; they are not counted.

    Returns:
        The recognition, or None if too few points are found or agree.
    """
    new = places.knows(key.numbers)
    if followed is not None:
        new &= ~np.isin(key.numbers, followed)
    numbers = key.numbers[new]
    if len(numbers) < FEWEST_POINTS:
        return None
    points = places.points(numbers).numpy()
    guess = picture.pixels(points @ pose[:3, :3].T + pose[:3, 3])
    shown = picture.shows(guess)
    if shown.sum() < max(FEWEST_POINTS, SHOWN * len(key.numbers)):
        return None
    numbers, points, guess = numbers[shown], points[shown], guess[shown]
    there, trusted = found_again(key.picture, picture, key.pixels[new][shown], guess)
    if trusted.sum() < max(FEWEST_POINTS, FOUND * len(numbers)):
        return None
    rays = picture.rays(there[trusted])
    found, off = placed(pose, points[trusted], rays, float(picture.camera.K[0, 0]))
    agree = off < AGREE_PX
    if agree.sum() < max(FEWEST_POINTS, AGREE * len(off)):
        return None
    return Recognised(key, places, found, numbers[trusted][agree], there[trusted][agree])


class PlaceRecognition:
    """Recognises key frames by rotation-invariant ORB features (Rublee et al. 2011)."""

    def __init__(self) -> None:
        self._orb: Any = cv2.ORB_create(nfeatures=FEATURES, nlevels=4)  # type: ignore[attr-defined]
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self._turn = 0

    def find(self, picture: SmallPicture, kept: Sequence[tuple[KeyFrame, LocalMap]], most: int) -> Recognised | None:
        """Try at most `most` key frames and return the first recognised one, or None. The next call tries the following ones."""
        candidates = [kept[(self._turn + number) % len(kept)] for number in range(min(most, len(kept)))]
        self._turn += len(candidates)
        if not candidates:
            return None
        corners, features = self._features(picture)
        if len(corners) < FEWEST_MATCHES:
            return None
        for key, places in candidates:
            pose = self._pose_by(key, places, picture, corners, features)
            if pose is not None:
                found = seen_again(key, places, picture, pose)
                if found is not None:
                    return found
        return None

    def _features(self, picture: SmallPicture) -> tuple[Points, Any]:
        corners, features = self._orb.detectAndCompute(picture.grey, picture.usable)
        return np.array([corner.pt for corner in corners], np.float32).reshape(-1, 2), features

    def _pose_by(
        self, key: KeyFrame, places: LocalMap, picture: SmallPicture, corners: Points, features: Any
    ) -> Pose | None:
        """Return an approximate pose of the picture by feature matches with a key frame; None with too few matches."""
        if key.features is None:
            key.features = self._features(key.picture)
        before, kept = key.features
        if len(before) < FEWEST_MATCHES:
            return None
        pairs = self._matcher.knnMatch(kept, features, k=2)
        matches = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < CLEARER * pair[1].distance]
        if len(matches) < FEWEST_MATCHES:
            return None
        rays = key.picture.rays(before[[match.queryIdx for match in matches]])
        known = places.knows(key.numbers)
        depth = places.depth_around(key.pose, rays, key.numbers[known], key.rays[known])
        points = unprojected(key.pose, rays, depth).numpy()
        there = picture.rays(corners[[match.trainIdx for match in matches]])
        found, turn, shift, agree = cv2.solvePnPRansac(
            points, there, np.eye(3), None, iterationsCount=TRIES, reprojectionError=MATCH_PX / float(picture.camera.K[0, 0])
        )  # fmt: skip
        if not found or agree is None or len(agree) < FEWEST_MATCHES:
            return None
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        return pose
