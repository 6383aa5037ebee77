"""Posed pictures that a static scene is trained on, and the coordinates that training uses.

Learning rates and densification thresholds of 3DGS assume cameras at a distance of about 1 from what they see. Scenes of
COLMAP have an arbitrary unit, so training uses centred and scaled coordinates, and the result is converted back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.colmap import ColmapScene, PosedImage
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

LEAST_POINTS = 4
"""Minimum number of points, so that each has three neighbours, from whose distance its scale follows."""
SCENE_MARGIN = 1.1
"""Factor from the largest distance of a camera from their mean to the extent of a scene (gsplat's `scene_scale`)."""


@dataclass(frozen=True)
class TrainingPicture:
    """Picture with its camera."""

    name: str
    camera: Camera
    image: NDArray[np.uint8]
    """RGB [H, W, 3], of the camera's size."""


@dataclass(frozen=True)
class Points:
    """Points from structure from motion, from which the Gaussians are initialised."""

    positions: NDArray[np.float64]
    """Positions of the points in the world, [N, 3]."""
    colours: NDArray[np.uint8]
    """Colours of the points, RGB [N, 3]."""


@dataclass(frozen=True)
class TrainingCoordinates:
    """Similarity transform from the world to training coordinates: x ↦ (x - centre) · factor."""

    centre: NDArray[np.float64]
    """Point [3] nearest to the optical axes, in world units."""
    factor: float
    """Inverse of the cameras' median distance from the centre, per world unit."""

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> TrainingCoordinates:
        """Return coordinates in which the centre of attention is 0 and the cameras' median distance is 1.

        Cameras with one optical axis, or at one place, see no centre. Their mean position is used instead.
        """
        positions = np.stack([camera.position for camera in cameras])
        centre = _nearest_to_axes(positions, np.stack([camera.world_to_camera[2, :3] for camera in cameras]))
        distance = float(np.median(np.linalg.norm(positions - centre, axis=1)))
        return cls(centre, 1 / distance if distance > 0 else 1.0)

    def camera(self, camera: Camera) -> Camera:
        """Return a camera with its pose in training coordinates."""
        pose = camera.world_to_camera.copy()
        pose[:3, 3] = (pose[:3, 3] + pose[:3, :3] @ self.centre) * self.factor
        return camera.with_pose(pose)

    def positions(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert positions [N, 3] to training coordinates."""
        return (positions - self.centre) * self.factor

    def to_world(self, gaussians: Gaussians) -> Gaussians:
        """Convert Gaussians in training coordinates to world coordinates."""
        centre = torch.tensor(self.centre, dtype=gaussians.dtype, device=gaussians.device)
        return replace(
            gaussians,
            means=gaussians.means / self.factor + centre,
            log_scales=gaussians.log_scales - float(np.log(self.factor)),
        )


def _nearest_to_axes(positions: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point [3] with the least sum of squared distances to the optical axes."""
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.sum(0)
    if np.linalg.cond(system) > 1e4:
        return np.asarray(positions.mean(0))
    return np.asarray(np.linalg.solve(system, (across @ positions[:, :, None]).sum(0))[:, 0])


def scene_extent(cameras: Sequence[Camera]) -> float:
    """Return the extent of a scene by its cameras, gsplat's `scene_scale`; 1 if all cameras are at one place."""
    positions = np.stack([camera.position for camera in cameras])
    return float(SCENE_MARGIN * np.linalg.norm(positions - positions.mean(0), axis=1).max()) or 1.0


def read_pictures(
    scene: ColmapScene,
    posed: Sequence[PosedImage],
    images: str = "images",
    scale: float = 1.0,
    read: Callable[[int], None] | None = None,
) -> tuple[TrainingPicture, ...]:
    """Read pictures of a scene into memory.

    Args:
        scene: scene of the pictures.
        posed: pictures to read.
        images: folder of the image files inside the scene.
        scale: factor on their size.
        read: called with the number of pictures read so far.

    Raises:
        RecordingInvalid: if a file is missing or damaged, or its shape differs from that of its camera.
        InvalidSetting: if nothing is left of a picture at `scale`.
    """
    pictures = []
    for number, each in enumerate(posed, 1):
        pictures.append(TrainingPicture(each.name, *scene.read(each, images, scale)))
        if read is not None:
            read(number)
    return tuple(pictures)


def read_points(scene: ColmapScene) -> Points:
    """Read the points of a scene.

    Raises:
        RecordingError: if there are less than `LEAST_POINTS` points, or their file is missing or malformed.
    """
    positions, colours = scene.points()
    if len(positions) < LEAST_POINTS:
        raise RecordingInvalid(
            f"{scene.sparse} has {len(positions)} points, and training begins with at least {LEAST_POINTS}; export the scene with its points3D"
        )
    return Points(positions, colours)
