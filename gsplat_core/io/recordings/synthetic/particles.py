"""Particles that float between the scope and the tissue, as in amniotic fluid or irrigation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.lamp import Lamp
from gsplat_core.scene.cameras import Camera

Array = NDArray[np.floating]
NEAREST_MM = 6.0
FOCUS = 0.8
"""Distance at which particles are sharp, as a share of the distance of the tissue."""
APERTURE = 1.2
"""Diameter of the aperture in mm, which sets the blur of particles that are out of focus."""


@dataclass(frozen=True)
class Particles:
    """Particles that drift through a box in front of the scope and wrap around at its sides."""

    places: NDArray[np.float64]
    """Positions at time 0 in shares of the box, [N, 3]."""
    velocities_mm_s: NDArray[np.float64]
    """Velocities of the particles, [N, 3]."""
    radii_mm: NDArray[np.float64]
    """Radii of the particles, [N]."""
    whiteness: NDArray[np.float64]
    """Reflectances of the particles, [N]."""
    box_mm: tuple[float, float, float]
    """Size of the box, which starts at the scope's plane at time 0 and is centred on its axis."""

    @classmethod
    def drawn(cls, random: np.random.Generator, count: int, size_mm: float, distance_mm: float) -> Particles:
        """Draw particles for tissue at a distance.

        Args:
            random: generator.
            count: number of particles.
            size_mm: median radius.
            distance_mm: distance of the tissue.
        """
        drift, own = random.normal(0, 3, 3), random.normal(0, 2, (count, 3))
        box = (1.6 * distance_mm, 1.6 * distance_mm, 0.9 * distance_mm)
        return cls(
            random.uniform(0, 1, (count, 3)),
            drift + own,
            size_mm * np.exp(random.normal(0, 0.5, count)),
            random.uniform(0.25, 0.9, count),
            box,
        )

    def over(self, radiance: Array, depth: Array, camera: Camera, lamp: Lamp, time_s: float) -> Array:
        """Draw the particles in front of the surfaces.

        Args:
            radiance: linear radiance [H, W, 3]; changed in place.
            depth: depth of the surfaces in mm [H, W].
            camera: camera of the picture.
            lamp: light source in camera coordinates.
            time_s: time in seconds.
        """
        box = np.array(self.box_mm)
        world = (self.places + self.velocities_mm_s * time_s / box) % 1.0 * box - [box[0] / 2, box[1] / 2, 0]
        local = world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        focus_mm = FOCUS * box[2] / 0.9
        height, width = depth.shape
        for at, radius_mm, white in zip(local, self.radii_mm, self.whiteness, strict=True):
            if at[2] < NEAREST_MM:
                continue
            column, row = (at @ camera.K.T)[:2] / at[2]
            if not (-20 < column < width + 20 and -20 < row < height + 20):
                continue
            focal_px = float(camera.K[0, 0])
            sharp_px = focal_px * radius_mm / at[2]
            blur_px = 0.5 * APERTURE * focal_px * abs(1 / at[2] - 1 / focus_mm)
            spread_px = float(np.hypot(max(sharp_px, 0.3), min(blur_px, 12.0))) + 0.35
            arriving = sum(float(power[0]) for _, power in lamp.rays_to(at[None].astype(np.float32), nearest_mm2=400))
            cover = min(1.0, (sharp_px / spread_px) ** 2)
            reach = int(np.ceil(2.5 * spread_px))
            top, left = max(0, int(row) - reach), max(0, int(column) - reach)
            bottom, right = min(height, int(row) + reach + 1), min(width, int(column) + reach + 1)
            if top >= bottom or left >= right:
                continue
            y, x = np.mgrid[top:bottom, left:right].astype(np.float32) + 0.5
            alpha = cover * np.exp(-((((x - column) ** 2 + (y - row) ** 2) / spread_px**2) ** 2))
            alpha = (alpha * (depth[top:bottom, left:right] > at[2])).astype(np.float32)[..., None]
            colour = np.float32(0.6 * white * min(arriving, 3.0)) * np.array([1.0, 0.93, 0.8], np.float32)
            part = radiance[top:bottom, left:right]
            part += alpha * (colour - part)
        return radiance
