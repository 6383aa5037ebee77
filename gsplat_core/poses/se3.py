"""Rigid motions of cameras in SE(3): exponential and logarithm of twists, inversion and interpolation of poses.

A twist is (translation [3], rotation vector [3] in radians). `exp` maps it to a pose [4, 4] between two coordinate
systems. All functions accept leading dimensions and are differentiable, so poses can be refined with the gradient of
a renderer by its `viewmats`: `exp(twist) @ viewmat` moves the camera by a small twist in camera coordinates.

Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendices B and D.

`CameraCorrections` learns corrections of camera poses, with priors, in one's own training loop. `Shutter` is the motion of a
camera with a rolling shutter, which reads out the rows or columns of a picture one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import require_shape

SMALL = 1e-4
"""Angle in radians below which Taylor series replace the quotients; the truncation error is below float64 precision."""


def hat(vector: Tensor) -> Tensor:
    """Return the skew-symmetric matrix [..., 3, 3] whose product with w is the cross product of
    `vector` [..., 3] and w.
    """
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).reshape(*vector.shape[:-1], 3, 3)


def exp(twist: Tensor) -> Tensor:
    """Return the pose [..., 4, 4] of a twist [..., 6], translation first (exponential map of SE(3))."""
    along, turn = twist[..., :3], twist[..., 3:]
    squared = (turn * turn).sum(-1)[..., None, None]
    cross = hat(turn)
    eye = torch.eye(3, dtype=twist.dtype, device=twist.device).expand_as(cross)
    a, b, c = _coefficients(squared)
    rotation = eye + a * cross + b * (cross @ cross)
    shift = (eye + b * cross + c * (cross @ cross)) @ along[..., None]
    last = torch.zeros_like(twist[..., :4])
    last = last + torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=twist.dtype, device=twist.device)
    return torch.cat([torch.cat([rotation, shift], -1), last[..., None, :]], -2)


def log(pose: Tensor) -> Tensor:
    """Return the twist [..., 6], translation first, of a pose [..., 4, 4] with a rotation of less than 180 degrees."""
    rotation, shift = pose[..., :3, :3], pose[..., :3, 3]
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    off = rotation - rotation.transpose(-1, -2)
    axis = 0.5 * torch.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], -1)
    sine = axis.norm(dim=-1)
    angle = torch.atan2(sine, 0.5 * (trace - 1))
    ratio = torch.where(angle < SMALL, 1 + angle**2 / 6, angle / sine.clamp(min=1e-300))
    turn = axis * ratio[..., None]
    squared = (turn * turn).sum(-1)[..., None, None]
    cross = hat(turn)
    eye = torch.eye(3, dtype=pose.dtype, device=pose.device).expand_as(cross)
    _, b, c = _coefficients(squared)
    along = torch.linalg.solve(eye + b * cross + c * (cross @ cross), shift[..., None])[..., 0]
    return torch.cat([along, turn], -1)


def inverse(pose: Tensor) -> Tensor:
    """Return the inverse pose [..., 4, 4]."""
    rotation = pose[..., :3, :3].transpose(-1, -2)
    shift = -rotation @ pose[..., :3, 3:]
    return torch.cat([torch.cat([rotation, shift], -1), pose[..., 3:, :]], -2)


def between(first: Tensor, second: Tensor, share: float) -> Tensor:
    """Interpolate poses [..., 4, 4] along one screw motion; `share` 0 gives `first`, 1 gives `second`."""
    return exp(share * log(second @ inverse(first))) @ first


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


def _coefficients(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin x / x, (1 - cos x) / x² and (x - sin x) / x³ for x² [...]."""
    small = squared < SMALL**2
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    a = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - squared / 24, (1 - torch.cos(angle)) / angle**2)
    c = torch.where(small, 1 / 6 - squared / 120, (angle - torch.sin(angle)) / angle**3)
    return a, b, c


class CameraCorrections(torch.nn.Module):
    """One rigid correction for each camera, applied in camera coordinates: exp(twist) @ viewmat.

    Poses and scene can move together without a change of the pictures. Fixed cameras and the prior prevent this.

    ```python
    corrections = CameraCorrections(len(viewmats), translation_sigma=0.5, rotation_sigma=0.01)
    optimiser = torch.optim.Adam(corrections.parameters(), lr=1e-3)
    image, _, _ = rasterization(..., viewmats=corrections(viewmats[ids], ids), ...)
    loss = (image - target).abs().mean() + 1e-3 * corrections.prior(ids)
    ```

    Args:
        count: number of cameras.
        translation_sigma: expected error of the positions in the scene's unit.
        rotation_sigma: expected error of the directions in radians.
        fixed: indices of cameras without correction; the first one by default.

    Raises:
        InvalidInput: for a sigma that is not positive, or a fixed camera that does not exist.
    """

    sigmas: Tensor
    """Expected errors [6] of a twist: of the translation in the scene's unit, of the rotation in radians."""
    free: Tensor
    """Factors [count, 1] on the twists: 0 for fixed cameras, which get no correction, else 1."""

    def __init__(
        self, count: int, *, translation_sigma: float, rotation_sigma: float, fixed: Sequence[int] = (0,)
    ) -> None:
        super().__init__()
        if not (0 < translation_sigma < float("inf") and 0 < rotation_sigma < float("inf")):
            raise InvalidInput(
                f"translation_sigma and rotation_sigma must be positive, got {translation_sigma} and {rotation_sigma}"
            )
        wrong = [index for index in fixed if not 0 <= index < count]
        if wrong:
            raise InvalidInput(f"fixed: there is no camera {wrong[0]}; the {count} cameras count from 0")
        self.normalised = torch.nn.Parameter(torch.zeros(count, 6))
        """Twists [count, 6] divided by their expected errors, so that one learning rate fits both parts."""
        sigmas = torch.tensor([translation_sigma] * 3 + [rotation_sigma] * 3)
        free = torch.ones(count, 1)
        free[list(fixed)] = 0
        self.register_buffer("sigmas", sigmas)
        self.register_buffer("free", free)

    def twists(self, ids: Tensor | None = None) -> Tensor:
        """Return the twists [..., 6] (translation, rotation vector) of cameras `ids` [...]; all by default."""
        chosen = self.normalised * self.free
        return (chosen if ids is None else chosen[ids]) * self.sigmas

    def forward(self, viewmats: Tensor, ids: Tensor | None = None) -> Tensor:
        """Return the corrected world-to-camera matrices.

        Args:
            viewmats: matrices [..., 4, 4] of the cameras `ids`.
            ids: integers [...]; None if `viewmats` are those of all cameras.

        Raises:
            InvalidInput: if the shapes do not match.
        """
        twists = self.twists(ids)
        if viewmats.shape != (*twists.shape[:-1], 4, 4):
            raise InvalidInput(
                f"viewmats must be {[*twists.shape[:-1], 4, 4]}, one for each camera of ids, got {list(viewmats.shape)}"
            )
        return exp(twists.to(viewmats.dtype)) @ viewmats

    def prior(self, ids: Tensor | None = None) -> Tensor:
        """Return the mean negative logarithm of the corrections' normal distribution, without its constant."""
        chosen = self.normalised * self.free
        return 0.5 * (chosen if ids is None else chosen[ids]).square().sum(-1).mean()

    def smoothness(self, step_sigma: float = 1.0) -> Tensor:
        """Return the mean negative logarithm of the normal distribution of differences between corrections of
        consecutive cameras of a video.

        Args:
            step_sigma: expected difference as a share of the expected errors.
        """
        if len(self.normalised) < 2:
            return self.normalised.sum() * 0
        return 0.5 * ((self.normalised * self.free).diff(dim=0) / step_sigma).square().sum(-1).mean()


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
        """True for a rolling shutter, whose rows or columns are read at different times."""
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
