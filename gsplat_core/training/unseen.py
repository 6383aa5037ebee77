"""Gaussians that nobody has seen for long: when each one was seen last, and where they are kept while the scene needs their rows."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.rows import RowMoves
from gsplat_core.training.observations import Observation


def pixels_of(means: Tensor, camera: Camera, margin_px: float = 0.0) -> tuple[Tensor, Tensor]:
    """Where the camera sees points [N, 3]: pixel coordinates [N, 2], and bool [N] whether that is in the picture or this close to it."""
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
    """How far points [N, 3] lie from the camera along its axis, [N]."""
    # Not a matrix product: cuBLAS takes tens of milliseconds for its first one in a thread, and a stream's first picture waits for this.
    x, y, z, offset = camera.world_to_camera[2].tolist()
    return x * means[:, 0] + y * means[:, 1] + z * means[:, 2] + offset


def value_at(plane: Tensor, pixels: Tensor) -> Tensor:
    """The values of a plane [H, W] at pixel coordinates [N, 2], those outside at the nearest pixel."""
    column = pixels[:, 0].long().clamp(0, plane.shape[1] - 1)
    row = pixels[:, 1].long().clamp(0, plane.shape[0] - 1)
    return plane[row, column]


class LastSeen:
    """When each Gaussian of a scene was seen last, in seconds of the stream; in memory of fixed size."""

    def __init__(self, capacity: int, device: torch.device) -> None:
        self._times = torch.zeros(capacity, dtype=torch.float64, device=device)
        self._count = 0
        self._looked_s = 0.0

    def times(self) -> Tensor:
        """For the Gaussians in use, float64 [N]; the same memory."""
        return self._times[: self._count]

    def join(self, count: int, time_s: float) -> None:
        """There are `count` Gaussians now; those that have joined are seen."""
        self._times[self._count : count] = time_s
        self._count = count

    def unseen_s(self, count: int) -> Tensor:
        """How long each of `count` Gaussians had not been seen at the last look, float64 [count], in memory of its own; 0 for those that were
        seen and for those that have joined since."""
        unseen = torch.zeros(count, dtype=self._times.dtype, device=self._times.device)
        unseen[: self._count] = (self._looked_s - self.times()).clamp(min=0)
        return unseen

    def restart(self) -> None:
        """There are other Gaussians from here on."""
        self._count = 0

    def see(self, now: Gaussians, observation: Observation) -> None:
        """Gaussians whose centre lies on tissue of the observation are seen now, and so are those that have joined.

        `now` are the scene's Gaussians at the observation's time. What lies behind other tissue counts as seen.
        """
        self.join(now.count, observation.time_s)
        self._looked_s = observation.time_s
        pixels, inside = pixels_of(now.means, observation.camera)
        seen = inside & (value_at(observation.mask, pixels) > 0)
        self.times().masked_fill_(seen, observation.time_s)

    def close_gaps(self, moves: RowMoves) -> None:
        """Gaussians leave."""
        moves.apply(self._times, 0.0)
        self._count = moves.count

    def longest_unseen(self, count: int, before_s: float, among: Tensor) -> Tensor:
        """Marks, bool [N], at most `count` of the Gaussians in `among`, bool [N], that were not seen since `before_s`; those unseen for the
        longest first."""
        times = self.times().masked_fill(~among, torch.inf)
        marks = torch.zeros(self._count, dtype=torch.bool, device=times.device)
        oldest = torch.argsort(times, stable=True)[:count]
        marks[oldest] = times[oldest] < before_s
        return marks


class Archive:
    """Gaussians that had to make room, as they were then, in host memory of bounded size."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._kept: Gaussians | None = None
        self.forgotten = 0
        """Gaussians that were dropped because there were more than `capacity`; those archived first."""

    def __len__(self) -> int:
        return 0 if self._kept is None else self._kept.count

    def put(self, gaussians: Gaussians) -> None:
        """Keep Gaussians; they are copied to the host."""
        added = gaussians.map(lambda tensor: tensor.detach().to("cpu"))
        kept = added if self._kept is None else self._kept.append(added)
        self.forgotten += max(0, kept.count - self._capacity)
        self._kept = kept.map(lambda tensor: tensor[-self._capacity :].clone()) if self._capacity else None

    def in_view(self, camera: Camera) -> Tensor:
        """Marks, bool [len], of those whose centre the camera has in its picture."""
        return torch.zeros(0, dtype=torch.bool) if self._kept is None else pixels_of(self._kept.means, camera)[1]

    def take_uncovered(self, camera: Camera, uncovered: Tensor, most: int) -> Gaussians | None:
        """At most `most` of those whose centre lies on a pixel of `uncovered`, bool [H, W], newest first; they are no longer kept then."""
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
