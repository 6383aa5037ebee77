"""Every view that a recording has of its frames, scored: further cameras, and a right eye."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.novel_view import NovelView, NovelViewSums, moved_picture, seen_by_both
from gsplat_core.evaluation.pictures import Picture
from gsplat_core.io.recordings.truth import GroundTruth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

Pose = NDArray[np.float64]
Shown = Callable[[Camera, Frame], Picture]
"""What a model shows of a frame's time and exposure from a camera in its own world."""


class ViewSums:
    """Takes frames in any order; a model whose lengths are to be multiplied by `scale` is seen from positions divided by it."""

    def __init__(self, camera: Camera, shown: Shown, truth: GroundTruth, scale: float = 1.0) -> None:
        """camera: of the frames."""
        self._camera, self._shown, self._truth, self._scale = camera, shown, truth, scale
        self._sums: dict[str, NovelViewSums] = {}

    def add(self, frame: Frame, own: Camera, depth: NDArray[Any] | None) -> None:
        """Score each view of a frame. own: the model's camera. depth: what the model shows from there, where that is at hand."""
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
        """How far away tissue typically is: by the true depth, or by the model's where that is not known."""
        known = np.zeros(0) if true is None else true[(true > 0) & (True if frame.mask is None else frame.mask != 0)]
        if not known.size:
            shows = self._shown(own, frame).depth if depth is None else depth
            known = self._scale * shows[shows > 0]
        return float(np.median(known)) if known.size else None

    @property
    def scores(self) -> tuple[NovelView, ...]:
        """The means so far."""
        return tuple(found for each in self._sums.values() if (found := each.score) is not None)


def _views_of(frame: Frame, truth: GroundTruth) -> Iterator[tuple[str, Camera, Frame]]:
    """The further cameras of a frame, and what they saw."""
    if frame.right_image is not None and frame.right_camera is not None:
        yield "right", frame.right_camera, Frame(frame.seq, frame.pts_ns, frame.right_image)
    for view in truth.views:
        yield view.name, view.camera, view.read(frame.seq)
