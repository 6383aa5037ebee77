"""Conversion of optical flow to 3D motion of visible Gaussians.

Depth is assumed constant between two frames, since one camera does not show motion along the line
of sight. Float32 points on the CPU use one compiled op. Other points use plain torch, which also
serves as the op's reference in tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.ops.surface_motion.surface_motion import surface_motion
from gsplat_core.scene.cameras import Camera

NEAREST = 1e-6
"""Smallest depth in world units of a point in front of a camera."""
INVERSE_STEPS = 2
"""Fixed-point iterations for inverting a flow."""


@dataclass(frozen=True)
class SurfaceMotion:
    """Motion of the surface between two frames: flow [h, w, 2] in pixels on the device, and both
    cameras.
    """

    flow: Tensor
    before: Camera
    after: Camera

    def seen_before(self, points: Tensor) -> Seen:
        """Project points [N, 3] to the first frame's camera."""
        return Seen(self.before, points)

    def ahead(self, points: Tensor) -> Tensor:
        """Return the world-space motion [N, 3] of points [N, 3] from the first frame to the second;
        0 outside the picture.
        """
        if self._is_compiled_for(points):
            return surface_motion(points, self.flow, self.before, self.after, arrived=False)
        seen = Seen(self.before, points)
        later = Seen(self.after, points)
        return later.to_world(seen.pixels + self.at(seen.pixels) - later.pixels, seen.inside)

    def arrived(self, points: Tensor) -> Tensor:
        """Return the world-space motion [N, 3] that brought points to their positions [N, 3] in the
        second frame.
        """
        if self._is_compiled_for(points):
            return surface_motion(points, self.flow, self.before, self.after, arrived=True)
        seen = Seen(self.after, points)
        earlier = Seen(self.before, points)
        came_from = seen.pixels
        for _ in range(INVERSE_STEPS):
            came_from = seen.pixels - self.at(came_from)
        return earlier.to_world(earlier.pixels - came_from, seen.inside)

    def at(self, pixels: Tensor) -> Tensor:
        """Sample the flow at pixels [N, 2] bilinearly, clamped at the picture's edge."""
        size = beside(pixels, [self.after.width_px, self.after.height_px])
        grid = (2 * pixels / size - 1).clamp(-2, 2)
        sampled = torch.nn.functional.grid_sample(
            self.flow.permute(2, 0, 1)[None], grid[None, None], padding_mode="border", align_corners=False
        )
        return sampled[0, :, 0].T

    def _is_compiled_for(self, points: Tensor) -> bool:
        """Return True if the compiled op supports these points; it is not differentiable."""
        return all(t.is_cpu and t.dtype == torch.float32 and not t.requires_grad for t in (points, self.flow))


class Seen:
    """Projection of points by a pinhole camera."""

    def __init__(self, camera: Camera, points: Tensor) -> None:
        """Compute `pixels` [N, 2], `depth` [N, 1] and `inside` (in the picture) [N, 1]."""
        view, intrinsics = camera.matrices(points.device, points.dtype)
        self._rotation = view[:3, :3]
        self._focal = intrinsics[[0, 1], [0, 1]]
        local = points @ self._rotation.T + view[:3, 3]
        self.depth = local[:, 2:].clamp(min=NEAREST)
        self.pixels = local[:, :2] / self.depth * self._focal + intrinsics[:2, 2]
        size = beside(points, [camera.width_px, camera.height_px])
        in_picture = ((self.pixels >= 0) & (self.pixels <= size)).all(dim=1, keepdim=True)
        self.inside = in_picture & (local[:, 2:] > NEAREST)

    def read(self, plane: Tensor) -> Tensor:
        """Sample a plane [H, W] at the points' pixels [N]; points outside get the value at the
        edge.
        """
        column, row = self.pixels.long().clamp(min=0).unbind(1)
        height, width = plane.shape
        return plane[row.clamp(max=height - 1), column.clamp(max=width - 1)]

    def to_world(self, moved_px: Tensor, inside: Tensor) -> Tensor:
        """Convert motion [N, 2] in pixels to world motion at the points' depth; 0 for points that
        are not `inside` [N, 1].
        """
        moved = torch.where(inside, moved_px * self.depth / self._focal, torch.zeros_like(moved_px))
        return moved @ self._rotation[:2]


def beside(tensor: Tensor, values: Sequence[float] | NDArray[np.floating]) -> Tensor:
    """Return a few numbers as a tensor on the device and of the type of `tensor`, copied without
    synchronisation (see `Camera.matrices`).
    """
    return torch.tensor(np.asarray(values), dtype=tensor.dtype).to(tensor.device, non_blocking=True)
