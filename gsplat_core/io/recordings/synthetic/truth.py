"""Exact optical flow, scene flow and point visibility of a synthetic scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.renderer import Eye
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.io.recordings.synthetic.sensor import RadialLens
from gsplat_core.scene.cameras import Camera

HIDDEN_MM = 0.5
"""Depth difference in mm from which a material point counts as hidden by a fold."""


@dataclass(frozen=True)
class Motion:
    """Motion from one frame to the next; NaN at tool pixels."""

    flow: NDArray[np.float32]
    """Optical flow of the left picture [H, W, 2] in pixels: pixel p moves to p + flow."""
    scene_flow: NDArray[np.float32]
    """Displacement of the tissue in the world [H, W, 3] in mm."""


def motion_to(scene: SyntheticScene, eye: Eye, time_s: float, next_s: float) -> Motion:
    """Compute the motion of each pixel's tissue point from one time to another.

    Args:
        scene: synthetic scene.
        eye: left camera's view at `time_s`.
        time_s: start time in seconds.
        next_s: end time in seconds.
    """
    now, then = (
        np.stack(scene.tissue.points(eye.u, eye.v, at, scene.tug(at)).position, axis=-1) for at in (time_s, next_s)
    )
    pixels, _ = projected(scene.camera_at(next_s), then.reshape(-1, 3), scene.lens)
    height, width = eye.u.shape
    here = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    flow = (pixels.reshape(height, width, 2) - here).astype(np.float32)
    moved = (then - now).astype(np.float32)
    flow[eye.tool], moved[eye.tool] = np.nan, np.nan
    return Motion(flow, moved)


def seen_points(scene: SyntheticScene, eye: Eye, time_s: float) -> NDArray[np.bool_]:
    """Return the visibility, bool [points], of the tracked points in the left camera.

    A point is visible if it is inside the picture, on the front surface and not behind the tool.
    """
    pixels, z = projected(scene.camera_at(time_s), scene.track(time_s), scene.lens)
    height, width = eye.u.shape
    column, row = (np.floor(pixels[:, k]).astype(int) for k in (0, 1))
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 0)
    column, row = column.clip(0, width - 1), row.clip(0, height - 1)
    # Half a pixel away the surface may be slightly nearer. Allow for its slope.
    slope = np.hypot(*np.gradient(eye.tissue_depth))[row, column]
    in_front = z <= eye.tissue_depth[row, column] + HIDDEN_MM + slope
    in_field = True if scene.inside is None else scene.inside[row, column]
    return np.asarray(inside & in_front & ~eye.tool[row, column] & in_field)


def projected(
    camera: Camera, points: NDArray, lens: RadialLens | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project world points [N, 3]; return pixels [N, 2] and z [N]."""
    local = points.astype(np.float64) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    if lens is not None:
        x, y = lens.bent(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
        return np.stack([x, y, np.ones_like(x)], axis=1) @ camera.K.T[:, :2], local[:, 2]
    return (local @ camera.K.T)[:, :2] / local[:, 2:], local[:, 2]
