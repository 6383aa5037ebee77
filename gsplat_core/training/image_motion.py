"""Motion of tissue from pictures: dense optical flow between consecutive pictures, and 3D motion of Gaussians from it.

Flow is extrapolated smoothly where pictures show no tissue. In 3D, depth is assumed constant between two frames, since
one camera does not show motion along the line of sight. Float32 points on the CPU use one compiled op. Other points
use plain torch, which also serves as the op's reference in tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.ops.surface_motion import surface_motion
from gsplat_core.scene.cameras import Camera

Flow: TypeAlias = NDArray[np.float32]
"""Optical flow: displacement of the visible points to the right and down in pixels of the full picture, float32 [h, w, 2], for
cells of `CELL_PX` x `CELL_PX` pixels.
"""
CELL_PX = 4
"""Side of a flow cell in pixels."""
SMALLEST_PX = 48
"""Shortest side of a picture for which flow is computed; the method needs patches of 8 pixels in a pyramid."""
WIDE_CELLS = 6.0
"""Standard deviation in flow cells of the wide average that fills in the flow where little or no tissue is visible."""
WIDE_WEIGHT = 0.02
"""Weight of the wide average of flow (`WIDE_CELLS`) relative to the flow of the cell itself."""
Detail: TypeAlias = Literal["full", "half"]
"""Resolution of the flow. `full` searches thoroughly at full size. `half` searches quickly and halves pictures of more
than `SMALL_PIXELS` pixels.
"""
SMALL_PIXELS = 150_000
"""Number of pixels up to which pictures are not halved, since that would lose detail and save little time."""


class ImageMotion:
    """Flow between consecutive pictures by DIS (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", 2016).

    Only the last picture is kept. The result does not depend on the number of threads.
    """

    def __init__(self, detail: Detail = "full") -> None:
        preset = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM if detail == "full" else cv2.DISOPTICAL_FLOW_PRESET_FAST
        self._method: Any = cv2.DISOpticalFlow.create(preset)
        self._shrinks = detail == "half"
        self._before: NDArray[np.uint8] | None = None
        self._mask_before: NDArray[np.uint8] | None = None

    def follow(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> Flow | None:
        """Add the next picture and return the flow from the previous one to it.

        Args:
            image: RGB uint8 [H, W, 3].
            mask: [H, W], non-zero on tissue, or None for all. Other pixels get the flow of the surrounding tissue.

        Returns:
            The flow, or None for the first picture, after a change of size, and for tiny pictures.
        """
        shape, mask_before = image.shape[:2], self._mask_before
        flow = self._pixel_flow(image)
        self._mask_before = mask
        if flow is None:
            return None
        tissue = np.ones(shape, np.uint8)
        for each in (mask, mask_before):
            if each is not None:
                tissue &= (each != 0).astype(np.uint8)
        return smoothed(flow, tissue)

    def _pixel_flow(self, image: NDArray[np.uint8]) -> NDArray[np.float32] | None:
        """Return the raw flow [h, w, 2] from the previous picture in pixels of the full picture; h and w are half its
        size if it was halved. None for the first picture, a new size or a tiny picture.
        """
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        height, width = grey.shape
        if self._shrinks and height * width > SMALL_PIXELS:
            grey = np.asarray(cv2.resize(grey, (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA))
        before, self._before = self._before, grey
        if before is None or before.shape != grey.shape or min(grey.shape) < SMALLEST_PX:
            return None
        flow = np.asarray(self._method.calc(before, grey, None), np.float32)
        return flow if grey.shape[1] == width else flow * (width / grey.shape[1])

    def forget(self) -> None:
        """Discard the last picture, so that the next one has no flow."""
        self._before = self._mask_before = None


def smoothed(flow: NDArray[np.float32], tissue: NDArray[np.uint8]) -> Flow:
    """Average flow [h, w, 2] over the tissue [H, W] of each cell, and over a wide neighbourhood
    where there is little tissue.
    """
    height, width = tissue.shape
    followed = tissue
    if flow.shape[:2] != tissue.shape:
        followed = np.asarray(cv2.resize(tissue, flow.shape[1::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    size = max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX))
    weight = cv2.resize(followed.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    moved = cv2.resize(flow * followed[..., None], size, interpolation=cv2.INTER_AREA)
    wide_weight = cv2.GaussianBlur(weight, (0, 0), WIDE_CELLS)
    wide = cv2.GaussianBlur(moved, (0, 0), WIDE_CELLS)
    total = (weight + WIDE_WEIGHT * wide_weight)[..., None]
    return np.asarray((moved + WIDE_WEIGHT * wide) / np.maximum(total, 1e-6), np.float32)


CONSISTENT_PX = 1.0
"""Largest distance in pixels between a pixel of reliable flow and its position after moving to the second picture and back."""


def consistent_flow(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    first_mask: NDArray[np.uint8] | None = None,
    second_mask: NDArray[np.uint8] | None = None,
) -> NDArray[np.float32]:
    """Return the DIS flow [H, W, 2] in pixels from one picture to another, NaN where it is not reliable.

    Reliable flow starts and arrives on tissue in the pictures, and the backward flow returns to within 1 px.

    Args:
        first: RGB uint8 [H, W, 3].
        second: RGB uint8 [H, W, 3].
        first_mask: [H, W], non-zero on tissue, or None for all.
        second_mask: the same for the second picture.
    """
    height, width = first.shape[:2]
    nothing = np.full((height, width, 2), np.nan, np.float32)
    if second.shape != first.shape or min(height, width) < SMALLEST_PX:
        return nothing
    one, other = (np.asarray(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), np.uint8) for each in (first, second))
    method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    ahead = np.asarray(method.calc(one, other, None), np.float32)
    back = np.asarray(method.calc(other, one, None), np.float32)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    there_x, there_y = x + ahead[..., 0], y + ahead[..., 1]
    returned = cv2.remap(back, there_x, there_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    reliable = np.linalg.norm(ahead + returned, axis=2) <= CONSISTENT_PX
    reliable &= (there_x >= 0) & (there_x <= width - 1) & (there_y >= 0) & (there_y <= height - 1)
    if first_mask is not None:
        reliable &= first_mask != 0
    if second_mask is not None:
        arrives = cv2.remap((second_mask != 0).astype(np.uint8), there_x, there_y, cv2.INTER_NEAREST)
        reliable &= arrives != 0
    return np.where(reliable[..., None], ahead, nothing)


def typical_px(flow: Flow) -> float:
    """Return the median length of the flow in pixels."""
    return float(np.median(np.linalg.norm(flow, axis=2)))


def revealed_px(flow: Flow) -> float:
    """Return the width in pixels of the largest strip revealed by inward motion at any edge of the picture."""
    inwards = (flow[:, 0, 0], -flow[:, -1, 0], flow[0, :, 1], -flow[-1, :, 1])
    return max(float(np.maximum(each, 0).mean()) for each in inwards)


NEAREST = 1e-6
"""Depth in world units above which a point counts as in front of a camera."""
INVERSE_STEPS = 2
"""Number of fixed-point iterations that find where a point of the second picture was in the first one."""


@dataclass(frozen=True)
class SurfaceMotion:
    """Motion of the surface between two frames: flow [h, w, 2] in pixels on the device, and both cameras."""

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
        """Return the world-space motion [N, 3] that brought points to their positions [N, 3] in the second frame."""
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
        """Return True if the compiled op, which has no gradient, supports these points: float32 on the CPU without gradient."""
        return all(t.is_cpu and t.dtype == torch.float32 and not t.requires_grad for t in (points, self.flow))


class Seen:
    """World points projected into the picture of a pinhole camera."""

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
        """Sample a plane [H, W] at the points' pixels [N]; points outside get the value at the edge."""
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
    """Convert a few numbers to a tensor with the device and dtype of `tensor`, without synchronisation (see
    `Camera.matrices`).
    """
    return torch.tensor(np.asarray(values), dtype=tensor.dtype).to(tensor.device, non_blocking=True)
