"""3D motion of surface points from optical flow, compiled, for the CPU.

`gsplat_core.training.motion.image_motion` implements it in plain torch for any floating dtype and device.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.argument_checks import require_float32
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.scene.cameras import Camera


def surface_motion(points: Tensor, flow: Tensor, before: Camera, after: Camera, *, arrived: bool) -> Tensor:
    """Lift optical flow to the 3D motion of surface points (CPU).

    Args:
        points: float32 [N, 3], positions at the time of `before`, or of `after` if `arrived`.
        flow: float32 [h, w, 2] in pixels, from the picture of `before` to that of `after`.
        before: pinhole camera of the first picture.
        after: pinhole camera of the second picture.
        arrived: `points` are positions at the time of the second picture.

    Returns:
        Motion [N, 3] in the world; zero for points outside the picture.

    Raises:
        InvalidInput: for wrong shapes, dtypes or devices, and for other camera models.
    """
    require_float32("surface_motion", points=points, flow=flow)
    if points.device.type != "cpu":
        raise InvalidInput(f"surface_motion is for the CPU, got points on {points.device}; use SurfaceMotion there")
    for camera in (before, after):
        if camera.model != "pinhole":
            raise InvalidInput(f"surface_motion takes pinhole cameras, got {camera.model!r}")
    return torch.ops.gsplat_core.surface_motion(points, flow, _numbers(before), _numbers(after), arrived)


def _numbers(camera: Camera) -> Sequence[float]:
    K = camera.K
    pose: list[float] = camera.world_to_camera[:3].ravel().tolist()
    return [*pose, *map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width_px, camera.height_px))]


@torch.library.register_fake("gsplat_core::surface_motion")
def _fake(points: Tensor, flow: Tensor, before: Sequence[float], after: Sequence[float], arrived: bool) -> Tensor:
    return points.new_empty(points.shape)
