"""Recognition of earlier key frames in a picture, by a predicted pose or, if the pose is unknown,
by ORB features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.camera_placement import placed
from gsplat_core.geometry.local_map import KeyFrame, LocalMap, unprojected
from gsplat_core.geometry.point_flow import Points
from gsplat_core.geometry.stream_tracks import Numbers, SmallPicture, found_again

FEWEST_POINTS = 20
"""Fewest points of a key frame that must be found at their predicted positions."""
SHOWN = 0.4
"""Share of a key frame's points that must be inside the picture for it to be searched."""
FOUND = 0.3
"""Share of the searched points that must be found."""
AGREE, AGREE_PX = 0.5, 4.0
"""Share of the found points that must agree on a pose, and their largest reprojection error in
pixels.
"""
FEATURES = 400
"""Largest number of ORB features per picture."""
CLEARER = 0.8
"""Largest ratio of the best to the second-best descriptor distance of a match (Lowe's ratio test).
"""
FEWEST_MATCHES, MATCH_PX = 12, 8.0
"""Fewest RANSAC inliers and their largest reprojection error in pixels. The error is large because
their depth is interpolated from known points.
"""
TRIES = 100
"""RANSAC iterations."""

Pose = NDArray[np.float64]


@dataclass(frozen=True)
class Recognised:
    """Key frame recognised in a picture."""

    key: KeyFrame
    places: LocalMap
    pose: Pose
    """Pose of the picture estimated from these points alone, world to camera [4, 4]."""
    numbers: Numbers
    """Numbers of the points found, ascending."""
    pixels: Points
    """Pixel positions of these points [N, 2]."""


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
        """Return the first recognised of at most `most` key frames. Candidates rotate from call to
        call.
        """
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
        """Return an approximate pose of the picture by feature matches with a key frame, or None."""
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
