"""Visibility times of Gaussians, the archive of Gaussians removed from the scene, and their density on a picture grid."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians, RowMoves
from gsplat_core.training.observations import Observation


def pixels_of(means: Tensor, camera: Camera, margin_px: float = 0.0) -> tuple[Tensor, Tensor]:
    """Project points [N, 3]. Returns pixel coordinates [N, 2], and which are in the picture or
    within `margin_px` of it, bool [N].
    """
    viewmat, intrinsics = camera.matrices(means.device, means.dtype)
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    plane, z = points[:, :2], points[:, 2:]
    if camera.model == "fisheye":
        radius = plane.norm(dim=1, keepdim=True).clamp(min=1e-9)
        plane = plane * torch.atan2(radius, z) / radius
    elif camera.model == "pinhole":
        plane = plane / torch.where(z > 0, z, torch.inf)
    pixels = plane * intrinsics.diagonal()[:2] + intrinsics[:2, 2]
    size = pixels.new_tensor([camera.width_px, camera.height_px])
    return pixels, ((pixels >= -margin_px) & (pixels < size + margin_px)).all(1) & (z[:, 0] > 0)


def depth_of(means: Tensor, camera: Camera) -> Tensor:
    """Return the depth of points [N, 3] along the camera's axis, [N]."""
    # Not a matrix product: cuBLAS takes tens of milliseconds for its first use in a thread, which would
    # delay a stream's first picture.
    x, y, z, offset = camera.world_to_camera[2].tolist()
    return x * means[:, 0] + y * means[:, 1] + z * means[:, 2] + offset


def value_at(plane: Tensor, pixels: Tensor) -> Tensor:
    """Sample a plane [H, W] at pixel coordinates [N, 2], clamped to the edge."""
    column = pixels[:, 0].long().clamp(0, plane.shape[1] - 1)
    row = pixels[:, 1].long().clamp(0, plane.shape[0] - 1)
    return plane[row, column]


class LastSeen:
    """Time at which each Gaussian was last visible, in seconds of the stream, in constant memory."""

    def __init__(self, capacity: int, device: torch.device) -> None:
        self._times = torch.zeros(capacity, dtype=torch.float64, device=device)
        self._count = 0
        self._looked_s = 0.0

    def times(self) -> Tensor:
        """Return the times of the Gaussians in use, float64 [N], without a copy."""
        return self._times[: self._count]

    def join(self, count: int, time_s: float) -> None:
        """Set the number of Gaussians. Added Gaussians count as visible at `time_s`."""
        self._times[self._count : count] = time_s
        self._count = count

    def unseen_s(self, count: int) -> Tensor:
        """Return for each of `count` Gaussians how long it was out of view at the last update,
        float64 [count] seconds, as a copy. Visible and newly added ones get 0.
        """
        unseen = torch.zeros(count, dtype=self._times.dtype, device=self._times.device)
        unseen[: self._count] = (self._looked_s - self.times()).clamp(min=0)
        return unseen

    def restart(self) -> None:
        """Remove all Gaussians; those of the next scene get their times when they join."""
        self._count = 0

    def see(self, now: Gaussians, observation: Observation) -> None:
        """Mark Gaussians as visible whose centre is on tissue of the observation, and newly added ones.

        `now` is the scene at the observation's time. Occluded Gaussians count as visible.
        """
        self.join(now.count, observation.time_s)
        self._looked_s = observation.time_s
        pixels, inside = pixels_of(now.means, observation.camera)
        seen = inside & (value_at(observation.mask, pixels) > 0)
        self.times().masked_fill_(seen, observation.time_s)

    def close_gaps(self, moves: RowMoves) -> None:
        """Remove the times of removed Gaussians. `moves` overwrites their rows with the last remaining rows."""
        moves.apply(self._times, 0.0)
        self._count = moves.count

    def longest_unseen(self, count: int, before_s: float, among: Tensor) -> Tensor:
        """Mark at most `count` Gaussians in `among`, bool [N], that were not visible since
        `before_s`, longest first. Returns bool [N].
        """
        times = self.times().masked_fill(~among, torch.inf)
        marks = torch.zeros(self._count, dtype=torch.bool, device=times.device)
        oldest = torch.argsort(times, stable=True)[:count]
        marks[oldest] = times[oldest] < before_s
        return marks


class Archive:
    """Gaussians removed from the scene in their last state, in bounded host memory."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._kept: Gaussians | None = None
        self.forgotten = 0
        """Number of Gaussians dropped because of the capacity, oldest first."""

    def __len__(self) -> int:
        return 0 if self._kept is None else self._kept.count

    def put(self, gaussians: Gaussians) -> None:
        """Copy Gaussians to the archive, from which they return when the camera sees their tissue again."""
        added = gaussians.map(lambda tensor: tensor.detach().to("cpu"))
        kept = added if self._kept is None else self._kept.append(added)
        self.forgotten += max(0, kept.count - self._capacity)
        self._kept = kept.map(lambda tensor: tensor[-self._capacity :].clone()) if self._capacity else None

    def in_view(self, camera: Camera) -> Tensor:
        """Return which archived Gaussians have their centre in a camera's picture, bool [len]."""
        return torch.zeros(0, dtype=torch.bool) if self._kept is None else pixels_of(self._kept.means, camera)[1]

    def take_uncovered(self, camera: Camera, uncovered: Tensor, most: int) -> Gaussians | None:
        """Remove and return at most `most` Gaussians whose centre is on a marked pixel of
        `uncovered`, bool [H, W], newest first; None without any.
        """
        if self._kept is None or most <= 0:
            return None
        pixels, inside = pixels_of(self._kept.means, camera)
        wanted = torch.nonzero(inside & value_at(uncovered.cpu(), pixels)).flatten()[-most:]
        if len(wanted) == 0:
            return None
        taken = self._kept.select(wanted)
        stays = torch.ones(self._kept.count, dtype=torch.bool)
        stays[wanted] = False
        self._kept = self._kept.select(stays) if bool(stays.any()) else None
        return taken


DEPTH_STEPS = 2**24
"""Quantisation steps of the largest depth, as fine as float32."""


def around_cells(
    now: Gaussians, camera: Camera, spacing: float, shape: tuple[int, int], reach: int = 1
) -> tuple[Tensor, Tensor]:
    """Count Gaussian centres around each cell of a picture grid and average their depth.

    Args:
        now: the scene at the camera's time.
        camera: camera of the picture.
        spacing: side of a cell in pixels.
        shape: number of rows and columns of cells.
        reach: number of neighbouring cells on each side that are included, also beyond the picture's edge.

    Returns:
        Number of centres and their mean depth (0 for none), float32 [rows, columns] each.
    """
    rows, columns = (cells + 2 * reach for cells in shape)
    pixels, near = pixels_of(now.means, camera, margin_px=reach * spacing)
    cells = torch.floor(pixels / spacing).long() + reach
    inside = near & (cells[:, 0] < columns) & (cells[:, 1] < rows) & (cells >= 0).all(1)
    index = torch.where(inside, cells[:, 1] * columns + cells[:, 0], 0)
    depth = depth_of(now.means, camera)
    # Integer sums on a GPU do not depend on the order of summation.
    quantum = depth.abs().amax().clamp(min=1e-30) / DEPTH_STEPS if len(depth) else depth.new_ones(())
    each = torch.stack([torch.ones_like(index), torch.round(depth / quantum).long()]) * inside
    sums = each.new_zeros(2, rows * columns).index_add_(1, index, each).to(torch.float32)
    width = 2 * reach + 1
    count, total = torch.nn.functional.avg_pool2d(sums.view(2, rows, columns), width, stride=1) * width**2
    return count, total / count.clamp(min=1) * quantum
