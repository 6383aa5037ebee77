"""Depth by parallax for a stream from a moving scope, comparing each frame with earlier key frames."""

from __future__ import annotations

import numpy as np

from gsplat_core.geometry.depth_agreement import UNCONFIRMED, Look, agree
from gsplat_core.geometry.depth_map import DepthMap, doubted
from gsplat_core.geometry.multiview import DEFORMS, depth_of_view, view_of
from gsplat_core.geometry.plane_sweep import View
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame

STREAM_PX = 160
"""Longest side of the compared pictures in pixels; smaller than offline to keep up with the stream.
"""
MOST_KEY_FRAMES = 8
"""Largest number of key frames. When it is exceeded, one of the two closest key frames is removed.
"""
LONGEST_S = 3.0
"""Largest age of a key frame in seconds, limited because tissue deforms."""
EVERY_S = 0.2
"""Time between two depth estimates in seconds; until the first one every frame is tried."""


class ParallaxDepth:
    """Depth estimator by parallax for streams, with bounded memory and time per frame.

    Depth is estimated every `EVERY_S` and not for the frames between. A depth map is returned only
    if it agrees with the previous one (`depth_agreement`). Frames without a pose, and cameras other
    than pinholes, get no depth.
    """

    def __init__(self) -> None:
        self._kept: list[tuple[float, View]] = []
        self._found_s: float | None = None
        self._look: Look | None = None
        """Depth map found at `_found_s`."""

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
        """Return the depth if it agrees with the previous depth map, a rejected map if not, or None
        for the first one.
        """
        is_first = self._found_s is None or not 0 <= now_s - self._found_s <= LONGEST_S
        before, self._look = self._look, Look.of(found.depth, found.confidence, camera)
        self._found_s = now_s
        if is_first or before is None:
            return None
        return found if agree(before, self._look) else doubted(found.depth.shape, found.origin, UNCONFIRMED)

    def _is_elsewhere(self, camera: Camera) -> bool:
        """Return True if the scope is farther from every key frame than the closest two key frames
        are from each other, or if there are still few key frames.
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
        """Return the distance of each key frame to its nearest neighbour."""
        views = [view for _, view in self._kept]
        return [min(_apart(one, other) for other in views if other is not one) for one in views]


def _apart(one: View, other: View) -> float:
    return float(np.linalg.norm(one.camera.position - other.camera.position))
