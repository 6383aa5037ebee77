"""A camera: intrinsics, pose, size and projection model; projection between its pixels and points, and orbits around its target."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsplat_core.errors import InvalidInput, InvalidSetting

if TYPE_CHECKING:
    import torch
    from torch import Tensor

CameraModel = Literal["pinhole", "ortho", "fisheye"]
CAMERA_MODELS: tuple[str, ...] = get_args(CameraModel)
MIN_FOCAL_PX, MAX_INTRINSICS_PX = 1e-3, 1e7
"""Smallest focal length, and largest focal length and distance of the principal point from the origin, in every file
that contains a camera."""


def _matrix(value: ArrayLike, size: int, name: str) -> NDArray[np.float64]:
    matrix = np.array(value, dtype=np.float64)
    if matrix.shape != (size, size):
        raise InvalidInput(f"camera: {name} must be [{size}, {size}], got {list(matrix.shape)}")
    if not np.isfinite(matrix).all():
        raise InvalidInput(f"camera: {name} holds values that are not finite: {matrix.tolist()}")
    matrix.setflags(write=False)
    return matrix


@dataclass(frozen=True, eq=False)
class Camera:
    """Immutable camera in OpenCV axes (x right, y down, z forward).

    The centre of pixel (column i, row j) is (i + 0.5, j + 0.5). The models map a camera-space point
    (x, y, z) as follows. pinhole: (fx x/z + cx, fy y/z + cy). fisheye (equidistant): (fx θ x/r +
    cx, fy θ y/r + cy) with r = |(x, y)| and θ = atan2(r, z). ortho: (fx x + cx, fy y + cy), where
    fx and fy are pixels per unit of length.

    Raises:
        InvalidInput: for a wrong shape, a non-finite value, a focal length or size that is not
            positive, a pose with a last row other than (0, 0, 0, 1), or an unknown model.
    """

    K: NDArray[np.float64]
    """Intrinsics [3, 3], in pixels."""
    width_px: int
    height_px: int
    world_to_camera: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    """World-to-camera pose [4, 4]; lengths in the unit of the scene (millimetres if its scale is known)."""
    model: CameraModel = "pinhole"

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", _matrix(self.K, 3, "K"))
        object.__setattr__(self, "world_to_camera", _matrix(self.world_to_camera, 4, "world_to_camera"))
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise InvalidInput(f"camera: focal lengths must be positive, got {self.K[0, 0]} and {self.K[1, 1]} px")
        if self.K[0, 1] != 0 or self.K[1, 0] != 0 or self.K[2].tolist() != [0, 0, 1]:
            raise InvalidInput(
                f"camera: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew), got {self.K.tolist()}"
            )
        if self.world_to_camera[3].tolist() != [0, 0, 0, 1]:
            raise InvalidInput(
                f"camera: the pose's last row must be (0, 0, 0, 1), got {self.world_to_camera[3].tolist()}"
            )
        if self.width_px < 1 or self.height_px < 1:
            raise InvalidInput(f"camera: the size must be at least 1x1 px, got {self.width_px}x{self.height_px}")
        if self.model not in CAMERA_MODELS:
            raise InvalidInput(f"camera: unknown model {self.model!r}; the models are {', '.join(CAMERA_MODELS)}")

    @classmethod
    def from_focal(
        cls, focal_px: float, width_px: int, height_px: int, world_to_camera: ArrayLike | None = None
    ) -> Camera:
        """Return a pinhole camera with square pixels and its principal point in the middle of the image."""
        K = np.array([[focal_px, 0, width_px / 2], [0, focal_px, height_px / 2], [0, 0, 1]])
        pose = np.eye(4) if world_to_camera is None else np.asarray(world_to_camera, dtype=np.float64)
        return cls(K, width_px, height_px, pose)

    @property
    def viewmat(self) -> Tensor:
        """World-to-camera matrix as a float32 tensor [4, 4]."""
        import torch

        return torch.tensor(self.world_to_camera, dtype=torch.float32)

    @property
    def intrinsics(self) -> Tensor:
        """Intrinsic matrix K as a float32 tensor [3, 3]."""
        import torch

        return torch.tensor(self.K, dtype=torch.float32)

    def matrices(self, device: torch.device, dtype: torch.dtype | None = None) -> tuple[Tensor, Tensor]:
        """Return the world-to-camera matrix [4, 4] and K [3, 3] on `device`.

        The copies are asynchronous. The dtype is float32 by default.
        """
        import torch

        # Copy pose and K in one transfer. CUDA copies so few bytes immediately, so the source may be freed.
        values = np.concatenate([self.world_to_camera.ravel(), self.K.ravel()])
        both = torch.tensor(values, dtype=dtype or torch.float32)
        both = both.to(device, non_blocking=True)
        return both[:16].view(4, 4), both[16:].view(3, 3)

    @property
    def position(self) -> NDArray[np.float64]:
        """Camera centre in world coordinates, [3]."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return np.asarray(-np.linalg.solve(rotation, translation))

    def scaled(self, factor: float) -> Camera:
        """Return the camera with a picture size multiplied by `factor` and rounded; intrinsics match the rounded size exactly."""
        if not factor > 0:
            raise InvalidInput(f"camera: the scale factor must be positive, got {factor}")
        return self.resized(max(1, round(self.width_px * factor)), max(1, round(self.height_px * factor)))

    def resized(self, width_px: int, height_px: int) -> Camera:
        """Return the camera for pictures of another size, stretched if the aspect ratio differs."""
        K = self.K.copy()
        K[0] *= width_px / self.width_px
        K[1] *= height_px / self.height_px
        return replace(self, K=K, width_px=width_px, height_px=height_px)

    def fitted(self, width_px: int, height_px: int) -> Camera:
        """Return the camera for pictures of another size and aspect ratio, with the same vertical field of view."""
        factor = height_px / self.height_px
        K = self.K.copy()
        K[:2] *= factor
        K[0, 2] += (width_px - self.width_px * factor) / 2
        return replace(self, K=K, width_px=width_px, height_px=height_px)

    def with_pose(self, world_to_camera: ArrayLike) -> Camera:
        """Return the camera with another world-to-camera pose [4, 4]."""
        return replace(self, world_to_camera=np.asarray(world_to_camera, dtype=np.float64))

    def right_eye(self, baseline: float) -> Camera:
        """Return the right eye's camera of a rectified pair in which this is the left camera.

        The intrinsics are equal. The pose maps left-camera coordinates to its own (`Frame.right_camera`).

        Args:
            baseline: distance between the eyes in the scene's unit.

        Raises:
            InvalidInput: if `baseline` is not positive.
        """
        if not 0 < baseline < float("inf"):
            raise InvalidInput(f"camera: the distance between the eyes must be positive, got {baseline}")
        pose = np.eye(4)
        pose[0, 3] = -baseline
        return self.with_pose(pose)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Camera):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[bytes, bytes, int, int, str]:
        # Adding 0.0 turns -0.0 into 0.0, so that equal poses have equal bytes.
        pose = self.world_to_camera + 0.0
        return (self.K + 0.0).tobytes(), pose.tobytes(), self.width_px, self.height_px, self.model


Points = NDArray[np.float64]


def pixel_rays(camera: Camera) -> Points:
    """Return the rays (x/z, y/z, 1) through the pixel centres [H, W, 3]."""
    column = (np.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    row = (np.arange(camera.height_px) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    x, y = np.meshgrid(column, row)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def points_of(camera: Camera, depth: NDArray[Any]) -> Points:
    """Unproject a depth map z [H, W] to camera-space points [H, W, 3]."""
    return pixel_rays(camera) * np.asarray(depth, np.float64)[..., None]


def inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a rigid pose [4, 4]."""
    return np.asarray(np.linalg.inv(pose), np.float64)


def moved(pose: NDArray[np.float64], points: Points) -> Points:
    """Transform points [..., 3] by a rigid pose [4, 4]."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def pixels_of(camera: Camera, points: Points) -> Points:
    """Project camera-space points [..., 3] to pixels [..., 2]; NaN for points not in front."""
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = points[..., :2] / np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
    return np.asarray(slopes * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2])


def at_pixels(plane: NDArray[Any], pixels: Points) -> NDArray[Any]:
    """Return the values [...] of a plane [H, W] at the pixels that contain the positions [..., 2]; 0 outside the picture."""
    height, width = plane.shape[:2]
    inside = np.isfinite(pixels).all(axis=-1)
    column, row = (np.floor(np.where(inside, pixels[..., k], -1)).astype(np.int64) for k in (0, 1))
    inside &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = plane[row.clip(0, height - 1), column.clip(0, width - 1)]
    return np.where(inside, found, np.zeros((), plane.dtype))


MOST_DEG = 75.0
"""Maximum azimuth or elevation of an orbit in degrees; beyond it, surfaces are seen edge-on."""
LEAST_ZOOM, MOST_ZOOM = 0.25, 4.0


@dataclass(frozen=True)
class Orbit:
    """Pose of a virtual camera relative to a start camera.

    Raises:
        InvalidSetting: if a value is out of range.
    """

    azimuth_deg: float = 0.0
    """Rotation to the right around the point at the centre of the picture, in degrees."""
    elevation_deg: float = 0.0
    """Upward rotation around the point at the centre of the picture, in degrees."""
    zoom: float = 1.0
    """Factor by which the camera is closer to the point at the centre of the picture."""

    def __post_init__(self) -> None:
        for name, value in (("azimuth", self.azimuth_deg), ("elevation", self.elevation_deg)):
            if not abs(value) <= MOST_DEG:
                raise InvalidSetting(f"{name} is {value:g} degrees; it must be from -{MOST_DEG:g} to {MOST_DEG:g}")
        if not LEAST_ZOOM <= self.zoom <= MOST_ZOOM:
            raise InvalidSetting(f"zoom is {self.zoom:g}; it must be from {LEAST_ZOOM:g} to {MOST_ZOOM:g}")

    def camera(self, start: Camera, distance: float) -> Camera:
        """Return the virtual camera orbiting the point `distance` in front of `start`, in scene units.

        Without rotation and zoom this is `start`.

        Raises:
            InvalidInput: if the distance is not positive.
        """
        if not 0 < distance < math.inf:
            raise InvalidInput(f"the distance of the orbit is {distance}; it must be positive")
        azimuth, elevation = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        sin_a, cos_a, sin_e, cos_e = math.sin(azimuth), math.cos(azimuth), math.sin(elevation), math.cos(elevation)
        turn = np.eye(4)
        turn[:3, :3] = np.array([[1, 0, 0], [0, cos_e, -sin_e], [0, sin_e, cos_e]]) @ np.array(
            [[cos_a, 0, sin_a], [0, 1, 0], [-sin_a, 0, cos_a]]
        )
        to_pivot, back = np.eye(4), np.eye(4)
        to_pivot[2, 3], back[2, 3] = -distance, distance / self.zoom
        return start.with_pose(back @ turn @ to_pivot @ start.world_to_camera)
