"""Points of the tissue whose truth is known, followed by a model frame after frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.projection import Points, at_pixels, inverse, moved, pixels_of
from gsplat_core.evaluation.tracking import CarriedPoints, Tracking, TrackSums
from gsplat_core.io.recordings.truth import Tracks
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model


class FollowedPoints:
    """Takes frames in order. Each point starts in the first of them that sees it and at whose pixel the model has depth."""

    def __init__(self, model: Model, camera: Camera, tracks: Tracks) -> None:
        self._model, self._camera, self._tracks = model, camera, tracks
        count = tracks.points.shape[1]
        self._started = np.zeros(count, bool)
        self._start_px, self._start_true = np.zeros((count, 2)), np.zeros((count, 3))
        self._groups: list[tuple[NDArray[np.int64], CarriedPoints]] = []
        self._found: list[tuple[Points, Points]] = []
        """Of each compared frame: where the model has the points, and where they are, in the left camera's coordinates."""
        self._pixels, self._still = TrackSums(), TrackSums()

    def add(self, frame: Frame, own: Camera, shown: NDArray[Any]) -> None:
        """The next frame. own: the model's camera. shown: the model's depth z [H, W]."""
        pose = np.eye(4) if frame.pose is None else frame.pose
        true = moved(pose, self._tracks.points[frame.seq])
        true_px = pixels_of(self._camera, true)
        seen = self._tracks.seen[frame.seq]
        for index, carried in self._groups:
            now = seen[index]
            if not now.any():
                continue
            found = moved(own.world_to_camera, carried.at(frame.time_s))[now]
            there = index[now]
            self._found.append((found, true[there]))
            self._pixels.add(found, true[there], pixels_of(self._camera, found), true_px[there])
            self._still.add(self._start_true[there], true[there], self._start_px[there], true_px[there])
        self._begin(frame, own, shown, seen, true, true_px)

    def _begin(
        self,
        frame: Frame,
        own: Camera,
        shown: NDArray[Any],
        seen: NDArray[np.bool_],
        true: Points,
        true_px: Points,
    ) -> None:
        """Start the points that are seen for the first time: each at its pixel, at the model's depth there."""
        z = at_pixels(shown, true_px)
        new = np.flatnonzero(seen & ~self._started & (z > 0))
        if not len(new):
            return
        K = self._camera.K
        slopes = (true_px[new] - K[:2, 2]) / K[[0, 1], [0, 1]]
        local = np.concatenate([slopes, np.ones((len(new), 1))], axis=1) * z[new, None]
        world = moved(inverse(own.world_to_camera), local)
        self._groups.append((new, CarriedPoints(self._model, world, frame.time_s)))
        self._started[new] = True
        self._start_px[new], self._start_true[new] = true_px[new], true[new]

    def tracking(self, scale: float) -> Tracking | None:
        """What the errors come to; `scale`: the factor that a model's lengths lack. None where nothing was compared."""
        scaled = TrackSums()
        for found, true in self._found:
            scaled.add(scale * found, true, pixels_of(self._camera, found), pixels_of(self._camera, true))
        model, one_scale, still = self._pixels.errors, scaled.errors, self._still.errors
        if model is None or one_scale is None or still is None:
            return None
        return Tracking(model, one_scale, still, int(self._started.sum()), self._pixels.count)
