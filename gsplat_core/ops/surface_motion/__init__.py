"""3D motion of surface points from optical flow, compiled: between two pictures for the CPU, through several pictures for
both devices.

`gsplat_core.training.image_motion` implements it in plain torch for any floating dtype and device.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.ops.arguments import require_float32
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


def surface_path(points: Tensor, flows: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Follow surface points through several pictures by optical flow.

    Each step moves a point by the flow at its pixel, at its depth in the next picture. A point outside of the picture stays.

    Args:
        points: float32 [N, 3], positions at the time of the first camera.
        flows: float32 [T, h, w, 2] in pixels, from each picture to the next one, on the device of the points.
        cameras: pinhole cameras of the T + 1 pictures.

    Returns:
        Positions [N, T, 3] in the world, after each flow.

    Raises:
        InvalidInput: for wrong shapes or dtypes, and for other camera models.
    """
    require_float32("surface_path", points=points, flows=flows)
    if flows.ndim != 4 or flows.shape[3] != 2 or 0 in flows.shape[1:3] or len(cameras) != len(flows) + 1:
        raise InvalidInput(
            f"surface_path takes flows [T, h, w, 2] and T + 1 cameras, got {list(flows.shape)} and {len(cameras)} cameras"
        )
    for camera in cameras:
        if camera.model != "pinhole":
            raise InvalidInput(f"surface_path takes pinhole cameras, got {camera.model!r}")
    views = torch.tensor([_numbers(camera) for camera in cameras], dtype=torch.float32).to(points.device)
    return torch.ops.gsplat_core.surface_path(points, flows, views)


def _numbers(camera: Camera) -> Sequence[float]:
    K = camera.K
    pose: list[float] = camera.world_to_camera[:3].ravel().tolist()
    return [*pose, *map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width_px, camera.height_px))]


@torch.library.register_fake("gsplat_core::surface_motion")
def _fake(points: Tensor, flow: Tensor, before: Sequence[float], after: Sequence[float], arrived: bool) -> Tensor:
    return points.new_empty(points.shape)


@torch.library.register_fake("gsplat_core::surface_path")
def _fake_path(points: Tensor, flows: Tensor, views: Tensor) -> Tensor:
    return points.new_empty((points.shape[0], flows.shape[0], 3))
