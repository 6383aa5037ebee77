"""Depth of a stream from a moving scope, by comparing its frames with key frames that came before."""

from __future__ import annotations

import numpy as np

from gsplat_core.geometry.depth_agreement import UNCONFIRMED, Look, agree
from gsplat_core.geometry.depth_map import DepthMap, doubted
from gsplat_core.geometry.multiview import DEFORMS, depth_of_view, view_of
from gsplat_core.geometry.plane_sweep import View
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

STREAM_PX = 160
"""Longest side of the pictures that are compared: a quarter of the work of offline, for an error a third larger."""
MOST_KEY_FRAMES = 8
"""That are kept. When there are more, the one that is nearest to another leaves."""
LONGEST_S = 3.0
"""Key frames that are older are not compared: tissue does not stay as it is."""
EVERY_S = 0.2
"""Time between two frames whose depth is found; before the first one every frame is asked."""


class ParallaxDepth:
    """Finds depth every `EVERY_S`, and none for the frames between. Memory and time do not grow with the stream.

    Depth is given once a look agrees with the one before (`depth_agreement`).

    Frames without a pose, or of another projection than a pinhole, have nothing to find depth from.
    """

    def __init__(self) -> None:
        self._kept: list[tuple[float, View]] = []
        self._found_s: float | None = None
        self._look: Look | None = None
        """The one at `_found_s`."""

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """See `Estimator`."""
        if frame.new_scene is not None:
            self._kept, self._found_s, self._look = [], None, None
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

    def _confirmed(self, found: DepthMap, camera: Camera, now_s: float) -> DepthMap | None:
        """Return the depth if it agrees with the look before, else a doubted one; None for a first look."""
        is_first = self._found_s is None or not 0 <= now_s - self._found_s <= LONGEST_S
        before, self._look = self._look, Look.of(found.depth, found.confidence, camera)
        self._found_s = now_s
        if is_first or before is None:
            return None
        return found if agree(before, self._look) else doubted(found.depth.shape, found.origin, UNCONFIRMED)

    def _is_elsewhere(self, camera: Camera) -> bool:
        """Whether the scope is farther from every key frame than most of them from their neighbours, or there are few."""
        if not self._kept:
            return True
        nearest = min(float(np.linalg.norm(view.camera.position - camera.position)) for _, view in self._kept)
        return nearest > 0 and (len(self._kept) < MOST_KEY_FRAMES or nearest > min(self._gaps()))

    def _keep(self, now_s: float, view: View) -> None:
        self._kept.append((now_s, view))
        if len(self._kept) > MOST_KEY_FRAMES:
            # Of the two that are nearest to each other the older one comes first.
            self._kept.pop(int(np.argmin(self._gaps())))

    def _gaps(self) -> list[float]:
        """How far each key frame is from the nearest other one."""
        views = [view for _, view in self._kept]
        return [min(_apart(one, other) for other in views if other is not one) for one in views]


def _apart(one: View, other: View) -> float:
    return float(np.linalg.norm(one.camera.position - other.camera.position))
