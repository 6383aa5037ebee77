"""From flow in the picture to motion of the Gaussians that the picture shows.

A surface point's depth is taken not to change between two frames: pictures of one camera do not show motion along the line of sight.
Float32 points on the CPU take one compiled op; the same in plain torch is for all others, and what that op is tested against.
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
"""Depth in world units below which a point is not in front of a camera."""
INVERSE_STEPS = 2
"""Iterations to find where a pixel came from, in a flow that says where pixels go."""


@dataclass(frozen=True)
class SurfaceMotion:
    """How the surface moved from one frame to the next, as flow [h, w, 2] in pixels, on the device, and the cameras that saw both."""

    flow: Tensor
    before: Camera
    after: Camera

    def seen_before(self, points: Tensor) -> Seen:
        """Points [N, 3] as the first frame's camera sees them."""
        return Seen(self.before, points)

    def ahead(self, points: Tensor) -> Tensor:
        """World-space motion [N, 3] of `points` [N, 3] from where they are in the first frame to the second one; 0 outside the picture."""
        if self._is_compiled_for(points):
            return surface_motion(points, self.flow, self.before, self.after, arrived=False)
        seen = Seen(self.before, points)
        later = Seen(self.after, points)
        return later.to_world(seen.pixels + self.at(seen.pixels) - later.pixels, seen.inside)

    def arrived(self, points: Tensor) -> Tensor:
        """World-space motion [N, 3] by which points came to be where they are in the second frame, `points` [N, 3]."""
        if self._is_compiled_for(points):
            return surface_motion(points, self.flow, self.before, self.after, arrived=True)
        seen = Seen(self.after, points)
        earlier = Seen(self.before, points)
        came_from = seen.pixels
        for _ in range(INVERSE_STEPS):
            came_from = seen.pixels - self.at(came_from)
        return earlier.to_world(earlier.pixels - came_from, seen.inside)

    def at(self, pixels: Tensor) -> Tensor:
        """The flow at pixels [N, 2], bilinear; beyond the picture's edge that of the edge."""
        size = beside(pixels, [self.after.width_px, self.after.height_px])
        grid = (2 * pixels / size - 1).clamp(-2, 2)
        sampled = torch.nn.functional.grid_sample(
            self.flow.permute(2, 0, 1)[None], grid[None, None], padding_mode="border", align_corners=False
        )
        return sampled[0, :, 0].T

    def _is_compiled_for(self, points: Tensor) -> bool:
        """Whether the compiled op takes such points and this flow; it is not differentiable."""
        return all(t.is_cpu and t.dtype == torch.float32 and not t.requires_grad for t in (points, self.flow))


class Seen:
    """Points as a pinhole camera sees them."""

    def __init__(self, camera: Camera, points: Tensor) -> None:
        """`pixels` [N, 2], `depth` [N, 1], and whether each is `inside` the picture [N, 1]."""
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
        """What a plane [H, W] of the camera's picture holds at the points' pixels [N]; for points that are not `inside`, what its edge holds."""
        column, row = self.pixels.long().clamp(min=0).unbind(1)
        height, width = plane.shape
        return plane[row.clamp(max=height - 1), column.clamp(max=width - 1)]

    def to_world(self, moved_px: Tensor, inside: Tensor) -> Tensor:
        """Motion [N, 2] in pixels as motion in the world at the points' depth; none for points that are not `inside` [N, 1]."""
        moved = torch.where(inside, moved_px * self.depth / self._focal, torch.zeros_like(moved_px))
        return moved @ self._rotation[:2]


def beside(tensor: Tensor, values: Sequence[float] | NDArray[np.floating]) -> Tensor:
    """A few numbers on the device of `tensor` and of its type; the host does not wait for the copy (see `Camera.matrices`)."""
    return torch.tensor(np.asarray(values), dtype=tensor.dtype).to(tensor.device, non_blocking=True)
