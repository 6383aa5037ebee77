"""Points of the tissue and key frames that saw them, while the scope goes on: a bounded number of both, adjusted a little with every frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.geometry.bundle import Bundle
from gsplat_core.geometry.bundle import adjust as adjusted
from gsplat_core.geometry.point_flow import Points
from gsplat_core.geometry.pose import exp, inverse, log
from gsplat_core.geometry.stream_tracks import Numbers, SmallPicture

WINDOW = 12
"""The newest key frames, whose poses are adjusted."""
ANCHORS = 5
"""Earlier ones that share points with them, and stand."""
MOST_KEY_FRAMES = 40
"""That are kept; when there are more, one that lies near another leaves."""
NEIGHBOURS = 5
"""Known points around a new one, whose depth it starts with."""
MOST_SIGHTINGS = 1500
"""In a step of the adjustment: while there are fewer, as many steps are made as look at so many ..."""
MOST_ROUNDS = 5
"""... but not more."""


@dataclass
class KeyFrame:
    """A picture and the points that it showed."""

    pose: Tensor
    """World to camera [4, 4]."""
    numbers: Numbers
    """Of the points, ascending."""
    pixels: Points
    picture: SmallPicture
    rays: NDArray[np.float64]
    features: Any = None
    """By which it is recognised, once they were asked for."""

    @property
    def position(self) -> NDArray[np.float64]:
        """Of its camera."""
        return position_of(self.pose)


class LocalMap:
    """What is known of the tissue's places. Everything float64 on the CPU."""

    def __init__(self) -> None:
        self.keys: list[KeyFrame] = []
        """In the order of time."""
        self._numbers: Numbers = np.zeros(0, np.int64)
        self._points = torch.zeros(0, 3, dtype=torch.float64)

    def __len__(self) -> int:
        return len(self._numbers)

    def points(self, numbers: Numbers) -> Tensor:
        """Where known points are [N, 3]."""
        return self._points[torch.from_numpy(np.searchsorted(self._numbers, numbers))]

    def knows(self, numbers: Numbers) -> NDArray[np.bool_]:
        """Which of the points are known [N]."""
        return np.isin(numbers, self._numbers)

    def add_points(self, numbers: Numbers, places: Tensor) -> None:
        """New points; their numbers are larger than all before."""
        self._numbers = np.concatenate([self._numbers, numbers])
        self._points = torch.cat([self._points, places])

    def add_key(self, key: KeyFrame) -> None:
        """Another key frame, the newest."""
        self.keys.append(key)
        if len(self.keys) > MOST_KEY_FRAMES:
            # Those of the window are needed, and the first one says where the world is.
            places = np.stack([key.position for key in self.keys[:-WINDOW]])
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(len(places), np.inf))
            self.keys.pop(1 + int(np.argmin(apart[1:].min(1))))
            self._forget()

    def depth_around(
        self, pose: Tensor, rays: NDArray[np.float64], numbers: Numbers, seen: NDArray[np.float64]
    ) -> Tensor:
        """Depth of points seen along `rays` [N, 2]: that of the known points `numbers` around them, which are seen at `seen` [K, 2]."""
        local = self.points(numbers) @ pose[:3, :3].T + pose[:3, 3]
        apart = torch.cdist(torch.from_numpy(rays), torch.from_numpy(seen))
        nearest = apart.topk(min(NEIGHBOURS, len(numbers)), largest=False).indices
        return local[:, 2][nearest].median(1).values

    def brought_back(self, key: KeyFrame, after: Tensor, scale: float) -> None:
        """What came after an earlier key frame is off by what was found out when that one was seen again: the newest of it by a motion of the world `after` [4, 4]
        about the world's origin, behind a factor, the rest by a share of that."""
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
        """Key frames before the window, those that are nearest to a position first."""
        before = self.keys[:-WINDOW]
        order = np.argsort([float(np.linalg.norm(key.position - position)) for key in before], kind="stable")
        return [before[index] for index in order[:most]]

    def adjust(self) -> None:
        """A few steps of bundle adjustment over the newest key frames. The earliest one stands, and how far away its points are, as a median."""
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
        """Of the key frames before the window those that share most points with it."""
        seen = np.unique(np.concatenate([key.numbers for key in window]))
        before = self.keys[: -len(window)]
        shared = [int(np.isin(key.numbers, seen).sum()) for key in before]
        best = sorted(range(len(before)), key=lambda index: (-shared[index], -index))[:ANCHORS]
        return [before[index] for index in sorted(best) if shared[index] >= 6]

    def _depth_of(self, key: KeyFrame) -> Tensor:
        """Of the points of a key frame, as a median."""
        local = self.points(key.numbers) @ key.pose[2, :3] + key.pose[2, 3]
        return local.median()

    def _rescale(self, about: KeyFrame, factor: float) -> None:
        """All lengths times a factor, as seen from a key frame that stands."""
        if not 0.1 < factor < 10:
            return
        centre = torch.from_numpy(about.position)
        self._points = centre + factor * (self._points - centre)
        for key in self.keys:
            position = centre + factor * (torch.from_numpy(key.position) - centre)
            key.pose = key.pose.clone()
            key.pose[:3, 3] = -key.pose[:3, :3] @ position

    def _forget(self) -> None:
        """Points that no key frame shows any more."""
        seen = np.unique(np.concatenate([key.numbers for key in self.keys]))
        kept = np.isin(self._numbers, seen)
        self._numbers, self._points = self._numbers[kept], self._points[torch.from_numpy(kept)]


def unprojected(pose: Tensor, rays: NDArray[np.float64], depth: Tensor) -> Tensor:
    """Places in the world [N, 3] of points that the camera of a pose [4, 4] sees along `rays` [N, 2] at `depth` [N]."""
    local = torch.cat([torch.from_numpy(rays), torch.ones(len(rays), 1, dtype=torch.float64)], 1) * depth[:, None]
    return (local - pose[:3, 3]) @ pose[:3, :3]


def scaled(pose: Tensor, factor: float) -> Tensor:
    """The pose [4, 4] of a world whose lengths are so many times larger."""
    pose = pose.clone()
    pose[:3, 3] *= factor
    return pose


def position_of(pose: Tensor) -> NDArray[np.float64]:
    """Where a camera is [3]."""
    return np.asarray((-pose[:3, :3].T @ pose[:3, 3]).numpy())
