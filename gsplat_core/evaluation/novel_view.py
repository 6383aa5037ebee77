"""What a model shows from where training never looked, beside the left picture shown in its place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.evaluation.projection import at_pixels, inverse, moved, pixel_rays, pixels_of, points_of
from gsplat_core.evaluation.scores import Score, ScoreSums
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

SAME_DEPTH = 0.02
"""Two cameras see the same point where its depth agrees by this share."""
LEAST_SEEN = 0.05
"""A frame of which a view and training have less than this share in common is left out."""


@dataclass(frozen=True)
class NovelView:
    """Scores of one view, over the pixels of tissue that training saw from its own camera in the same frame."""

    name: str
    model: Score
    left: Score
    """The left picture, shown as it is."""
    shifted: Score
    """The left picture, moved as it would be if all tissue were at its median distance: shifted by the median disparity, for a right eye."""
    seen: float
    """Share of the view's pixels that were compared."""


class NovelViewSums:
    """Takes the frames of one view."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._model, self._left, self._shifted = ScoreSums(), ScoreSums(), ScoreSums()
        self._seen, self._frames = 0.0, 0

    def add(self, view: Frame, seen: NDArray[np.bool_], picture: Any, left: Any, shifted: Any) -> None:
        """Score a picture of the model and both baselines against what the view's camera saw, where `seen`."""
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
        """The means so far; None where nothing was scored."""
        if not self._frames:
            return None
        scores = self._model.score, self._left.score, self._shifted.score
        return NovelView(self._name, *scores, self._seen / self._frames)


def seen_by_both(
    left_camera: Camera, left: Frame, left_depth: NDArray[Any] | None, camera: Camera, view: Frame
) -> NDArray[np.bool_]:
    """The pixels of a view [H, W] whose tissue the left camera sees in the same frame. `camera`'s pose leads from the left camera's
    coordinates to its own.

    By depth where both have it. Where the view has none, by the left one's depth carried over; without any depth all of the view counts.
    """
    tissue = np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask != 0
    trained = np.ones(left.image.shape[:2], bool) if left.mask is None else left.mask != 0
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
    # Pixels are carried one by one, with gaps where the view is nearer.
    closed = cv2.morphologyEx(reached, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return np.asarray(tissue & (closed != 0))


def moved_picture(left_camera: Camera, image: NDArray[np.uint8], camera: Camera, distance: float) -> NDArray[np.uint8]:
    """The left picture as a view would show it if everything were on a plane before the left camera, so far away; edges repeated."""
    back = inverse(camera.world_to_camera)
    rays = pixel_rays(camera) @ back[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (distance - back[2, 3]) / rays[..., 2]
    pixels = pixels_of(left_camera, rays * reach[..., None] + back[:3, 3])
    at = np.nan_to_num(pixels - 0.5, nan=-1e4, posinf=1e4, neginf=-1e4).clip(-1e4, 1e4).astype(np.float32)
    moved_ = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved_, np.uint8)
