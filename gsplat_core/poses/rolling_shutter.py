"""Rolling shutter: camera poses of the rows or columns of a picture, read out one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_shape
from gsplat_core.poses.se3 import SMALL, exp


class RollingShutterType(Enum):
    """Read-out order of a sensor; names and values as in gsplat 1.5.3."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


@dataclass(frozen=True, eq=False)
class Shutter:
    """Motion of C cameras during the read-out: rotation along the shortest arc, translation linear in `viewmats`.

    The time is 0 at the centre of the first row or column and 1 at the centre of the last one. It is continuous, and
    continues outside the picture.
    """

    first: Tensor
    """World-to-camera matrices [..., C, 4, 4] at time 0."""
    shift: Tensor | None
    """Difference [..., C, 3] of the translations at times 1 and 0; None for a global shutter."""
    turn: Tensor | None
    """Rotation vector [..., C, 3] from the axes at time 0 to those at time 1; None for a global shutter."""
    kind: RollingShutterType = RollingShutterType.GLOBAL

    @classmethod
    def of(cls, viewmats: Tensor, viewmats_rs: Tensor | None, kind: RollingShutterType | None) -> Shutter:
        """Return the motion between the matrices at the start and the end of the read-out.

        Raises:
            InvalidInput: unless a rolling shutter has `viewmats_rs` [..., C, 4, 4], and a global one has none.
        """
        name = "GLOBAL" if kind is None else str(getattr(kind, "name", kind))
        if name not in RollingShutterType.__members__:
            kinds = ", ".join(RollingShutterType.__members__)
            raise InvalidInput(f"rolling_shutter must be a RollingShutterType ({kinds}), got {kind!r}")
        kind = RollingShutterType[name]
        if (viewmats_rs is None) != (kind is RollingShutterType.GLOBAL):
            raise InvalidInput(
                f"rolling_shutter={kind.name} needs viewmats_rs, the poses at the end of the read-out"
                if viewmats_rs is None
                else "viewmats_rs belong to a rolling shutter; leave them out, or choose a rolling_shutter other than GLOBAL"
            )
        if viewmats_rs is None:
            return cls(viewmats, None, None)
        require_shape("viewmats_rs", viewmats_rs, tuple(viewmats.shape), "[..., C, 4, 4]")
        relative = viewmats_rs[..., :3, :3] @ viewmats[..., :3, :3].transpose(-1, -2)
        return cls(viewmats, viewmats_rs[..., :3, 3] - viewmats[..., :3, 3], rotation_vector(relative), kind)

    @property
    def rolls(self) -> bool:
        """True if rows or columns have different times."""
        return self.turn is not None

    def times(self, pixels: Tensor, width: int, height: int) -> Tensor:
        """Return the read-out times of pixel positions [..., 2], from 0 (first row or column read) to 1 (last)."""
        horizontal = self.kind in (RollingShutterType.ROLLING_LEFT_TO_RIGHT, RollingShutterType.ROLLING_RIGHT_TO_LEFT)
        length = width if horizontal else height
        time = (pixels[..., 0 if horizontal else 1] - 0.5) / max(length - 1, 1)
        back = self.kind in (RollingShutterType.ROLLING_BOTTOM_TO_TOP, RollingShutterType.ROLLING_RIGHT_TO_LEFT)
        return 1 - time if back else time

    def to_camera(self, points: Tensor, times: Tensor | float = 0.5) -> Tensor:
        """Return world points [..., C or 1, M, 3] in the axes of each camera at `times` [..., C, M], [..., C, M, 3]."""
        turned = points @ self.first[..., :3, :3].transpose(-1, -2)
        shift = self.first[..., None, :3, 3]
        if self.shift is None or self.turn is None:
            return turned + shift
        times = times if isinstance(times, Tensor) else self.shift.new_full((1,), times)
        turned = rotated(self.turn[..., None, :] * times[..., None], turned)
        return turned + shift + self.shift[..., None, :] * times[..., None]

    def to_world(self, directions: Tensor, origins: Tensor, times: Tensor | float = 0.5) -> tuple[Tensor, Tensor]:
        """Return directions and origins [..., C, M, 3] of camera rays at `times` [..., C, M] in world axes."""
        offsets = origins - self.first[..., None, :3, 3]
        if self.shift is not None and self.turn is not None:
            times = times if isinstance(times, Tensor) else self.shift.new_full((1,), times)
            back = -self.turn[..., None, :] * times[..., None]
            offsets = rotated(back, offsets - self.shift[..., None, :] * times[..., None])
            directions = rotated(back, directions)
        rotation = self.first[..., :3, :3]
        return directions @ rotation, offsets @ rotation

    def matrices(self, time: float = 0.5) -> Tensor:
        """Return the world-to-camera matrices [..., C, 4, 4] at one time."""
        if self.shift is None or self.turn is None:
            return self.first
        turn = exp(torch.cat([torch.zeros_like(self.turn), self.turn * time], -1))[..., :3, :3]
        pose = torch.cat([turn @ self.first[..., :3, :3], (self.first[..., :3, 3] + self.shift * time)[..., None]], -1)
        return torch.cat([pose, self.first[..., 3:, :]], -2)


def rotation_vector(rotation: Tensor) -> Tensor:
    """Return the rotation vectors [..., 3] of matrices [..., 3, 3] that turn by less than 180 degrees.

    Differentiable at the identity, also in float32.
    """
    off = rotation - rotation.transpose(-1, -2)
    axis = 0.5 * torch.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], -1)
    squared = (axis * axis).sum(-1)
    small = squared < SMALL**2
    sine = torch.where(small, torch.ones_like(squared), squared).sqrt()
    angle = torch.atan2(sine, 0.5 * (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1))
    return axis * torch.where(small, 1 + squared / 6, angle / sine)[..., None]


def rotated(turns: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors [..., 3] by rotation vectors [..., 3] (Rodrigues' formula)."""
    squared = (turns * turns).sum(-1, keepdim=True)
    small = squared < SMALL**2
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    first = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    half = (0.5 * angle).sin() / angle
    second = torch.where(small, 0.5 - squared / 24, 2 * half * half)
    turns, vectors = torch.broadcast_tensors(turns, vectors)
    once = torch.linalg.cross(turns, vectors)
    return vectors + first * once + second * torch.linalg.cross(turns, once)
