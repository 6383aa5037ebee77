"""Virtual camera that orbits the point viewed by another camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera

MOST_DEG = 75.0
"""Maximum rotation in degrees; beyond it, surfaces are seen edge-on."""
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
    """Factor by which the camera is closer to that point."""

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
