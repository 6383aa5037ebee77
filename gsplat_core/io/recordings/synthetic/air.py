"""Drifting smoke between scope and tissue, and a varying camera exposure."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.synthetic.lamp import Lamp
from gsplat_core.scene.cameras import Camera

Array = NDArray[np.floating]

CLOUD_MM = 9.0
"""Cell size in mm of the noise that forms the smoke density."""
CELLS = 64
DRIFT_MM_S = (11.0, -7.0)
PUFF_PERIOD_S = 2.9
"""Period in seconds with which the smoke density varies."""
SMOKE_MM = 74.0
"""Path length in mm over which smoke of strength 1 and mean density transmits exp(-1) of the light."""
SMOKE_COLOUR = (0.42, 0.41, 0.44)
EXPOSURE_PERIODS_S = (1.9, 3.1)
EXPOSURE_STOPS = (0.45, 0.25)
"""Amplitudes of the exposure's oscillations in stops (factors of two), one per period."""


@dataclass(frozen=True)
class Air:
    """Smoke and exposure as functions of time."""

    smoke: float
    """Strength of the smoke; 0 for none."""
    exposure_changes: bool
    clouds: Array
    """Periodic noise [CELLS, CELLS] from 0 to about 2, mean 1."""

    @classmethod
    def from_seed(cls, seed: np.random.SeedSequence, smoke: float, exposure_changes: bool) -> Air:
        """Create the smoke and exposure of a scene."""
        noise = np.random.default_rng(seed).standard_normal((CELLS, CELLS)).astype(np.float32)
        wide = np.pad(noise, 4, mode="wrap")
        soft = cv2.GaussianBlur(wide, (0, 0), 1.0)[4:-4, 4:-4]
        return cls(smoke, exposure_changes, np.clip(1 + 0.55 * soft / soft.std(), 0, None).astype(np.float32))

    def exposure_at(self, time_s: float) -> float:
        """Return the exposure factor at a time; 1 at time 0."""
        if not self.exposure_changes:
            return 1.0
        stops = zip(EXPOSURE_STOPS, EXPOSURE_PERIODS_S, strict=True)
        return float(2 ** sum(most * np.sin(2 * np.pi * time_s / period) for most, period in stops))

    def through(
        self, radiance: Array, camera: Camera, ray_x: Array, ray_y: Array, depth: Array, lamp: Lamp, time_s: float
    ) -> Array:
        """Attenuate the radiance by smoke, add light scattered by it, and apply the exposure.

        Args:
            radiance: linear radiance [H, W, 3] leaving the surfaces.
            camera: camera of the picture.
            ray_x: x / z of each pixel's ray [H, W].
            ray_y: y / z of each pixel's ray [H, W].
            depth: depth of the surface in mm [H, W].
            lamp: light source in camera coordinates.
            time_s: time in seconds.

        Returns:
            Radiance at the sensor, float32 [H, W, 3].
        """
        if self.smoke:
            clear = self._transmitted(camera, ray_x, ray_y, depth, time_s)[..., None]
            # Illuminate smoke like a white surface half-way to the tissue, scaled down because smoke
            # is thin.
            half = np.stack([ray_x, ray_y, np.ones_like(ray_x)], axis=-1) * (0.5 * depth)[..., None]
            arriving = sum(power for _, power in lamp.rays_to(half, nearest_mm2=400))
            lit = np.minimum(np.float32(0.25) * arriving, np.float32(0.8))[..., None]
            radiance = clear * radiance + (1 - clear) * lit * np.array(SMOKE_COLOUR, np.float32)
        return np.asarray(np.float32(self.exposure_at(time_s)) * radiance, np.float32)

    def _transmitted(self, camera: Camera, ray_x: Array, ray_y: Array, depth: Array, time_s: float) -> Array:
        """Return the transmitted share of light [H, W], from the density at the middle of each ray."""
        half = np.float32(0.5) * depth
        local = np.stack([ray_x * half, ray_y * half, half], axis=-1)
        r, t = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        world = (local - t.astype(np.float32)) @ r.astype(np.float32)
        column, row = ((world[..., k] - DRIFT_MM_S[k] * time_s) / CLOUD_MM for k in (0, 1))
        density = cv2.remap(
            self.clouds,
            np.asarray(column, np.float32) % CELLS,
            np.asarray(row, np.float32) % CELLS,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        puff = 0.5 * (1 - np.cos(2 * np.pi * time_s / PUFF_PERIOD_S))
        return np.asarray(np.exp(np.float32(-2 * puff * self.smoke / SMOKE_MM) * density * depth), np.float32)
