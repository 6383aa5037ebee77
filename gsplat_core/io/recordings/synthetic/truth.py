"""Exact motion: where what a pixel shows is in the next frame, and which material points a frame sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.renderer import Eye
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.scene.cameras import Camera

HIDDEN_MM = 0.5
"""A material point so far behind the surface that its pixel shows is hidden by a fold of the tissue."""


@dataclass(frozen=True)
class Motion:
    """From one frame to the next, NaN where the tool is."""

    flow: NDArray[np.float32]
    """Optical flow of the left picture [H, W, 2], pixels: what is at pixel p is at p + flow then."""
    scene_flow: NDArray[np.float32]
    """How far the tissue moves in the world [H, W, 3], mm."""


def motion_to(scene: SyntheticScene, eye: Eye, time_s: float, next_s: float) -> Motion:
    """What moves how far from a frame that the left camera saw as `eye` to another time."""
    now, then = (
        np.stack(scene.tissue.points(eye.u, eye.v, at, scene.tug(at)).position, axis=-1) for at in (time_s, next_s)
    )
    pixels, _ = projected(scene.camera_at(next_s), then.reshape(-1, 3))
    height, width = eye.u.shape
    here = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    flow = (pixels.reshape(height, width, 2) - here).astype(np.float32)
    moved = (then - now).astype(np.float32)
    flow[eye.tool], moved[eye.tool] = np.nan, np.nan
    return Motion(flow, moved)


def seen_points(scene: SyntheticScene, eye: Eye, time_s: float) -> NDArray[np.bool_]:
    """Which of the points of `SyntheticScene.track` the left camera sees [points]: inside of its picture, and behind nothing."""
    pixels, z = projected(scene.camera_at(time_s), scene.track(time_s))
    height, width = eye.u.shape
    column, row = (np.floor(pixels[:, k]).astype(int) for k in (0, 1))
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 0)
    column, row = column.clip(0, width - 1), row.clip(0, height - 1)
    # Half a pixel away the surface may be a little nearer: allow for its slope.
    slope = np.hypot(*np.gradient(eye.tissue_depth))[row, column]
    in_front = z <= eye.tissue_depth[row, column] + HIDDEN_MM + slope
    return np.asarray(inside & in_front & ~eye.tool[row, column])


def projected(camera: Camera, points: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels [N, 2] and z [N] of points in the world [N, 3]."""
    local = points.astype(np.float64) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    return (local @ camera.K.T)[:, :2] / local[:, 2:], local[:, 2]
