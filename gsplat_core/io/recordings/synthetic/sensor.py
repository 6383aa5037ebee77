"""Optics and camera of a synthetic scope: distortion, field of view, exposure, noise and compression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera

Array = NDArray[np.floating]
Random = np.random.Generator


def develop(radiance: Array, contrast: float = 1.45) -> NDArray[np.uint8]:
    """Convert radiance to a picture: soft-shoulder tone curve, then sRGB (IEC 61966-2-1)."""
    exposed = 1 - np.exp(np.float32(-contrast) * radiance)
    curve = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * np.maximum(exposed, 1e-9) ** (1 / 2.4) - 0.055)
    return np.asarray(np.clip(np.round(255 * curve), 0, 255), np.uint8)


NEWTON_STEPS = 8


@dataclass(frozen=True)
class RadialLens:
    """Radial distortion of a lens, in OpenCV's model with the coefficients k1 and k2."""

    k1: float
    k2: float

    @classmethod
    def from_corner(cls, camera: Camera, first: float, second: float) -> RadialLens:
        """Return the lens that moves the picture's corners by a share of their distance from the centre.

        The terms of k1 and k2 contribute `first` and `second`; positive values move the corners outwards.
        """
        corner = float(np.hypot(camera.K[0, 2] / camera.K[0, 0], camera.K[1, 2] / camera.K[1, 1]))
        straight = corner / (1 + first + second)
        return cls(first / straight**2, second / straight**4)

    def rays(self, camera: Camera) -> tuple[Array, Array]:
        """Return x/z and y/z of the rays through the pixel centres, [H, W] each."""
        column = (np.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
        row = (np.arange(camera.height_px) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
        x, y = np.meshgrid(column, row)
        bent = np.maximum(np.hypot(x, y), 1e-12)
        straight = bent.copy()
        for _ in range(NEWTON_STEPS):
            r2 = straight * straight
            off = straight * (1 + r2 * (self.k1 + r2 * self.k2)) - bent
            straight -= off / (1 + r2 * (3 * self.k1 + 5 * r2 * self.k2))
        factor = straight / bent
        return (x * factor).astype(np.float32), (y * factor).astype(np.float32)

    def bent(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the distorted x/z and y/z of rays."""
        r2 = x * x + y * y
        factor = 1 + r2 * (self.k1 + r2 * self.k2)
        return x * factor, y * factor

    @property
    def coefficients(self) -> list[float]:
        """Coefficients k1, k2, p1, p2 of OpenCV's model."""
        return [self.k1, self.k2, 0.0, 0.0]


@dataclass(frozen=True)
class Field:
    """Visible part of the picture: everything, a circle or an octagon; the rest is dark."""

    kind: Literal["full", "circle", "octagon"] = "full"
    radius: float = 0.5
    """Radius of the circle, or distance of the octagon's sides from its centre, per longer side of the picture."""
    centre: tuple[float, float] = (0.5, 0.5)
    """Centre in shares of the picture's width and height."""

    def mask(self, width_px: int, height_px: int) -> NDArray[np.bool_]:
        """Return the visible pixels, bool [H, W]."""
        long_px = max(width_px, height_px)
        x = np.abs(np.arange(width_px) + 0.5 - self.centre[0] * width_px)[None] / long_px
        y = np.abs(np.arange(height_px) + 0.5 - self.centre[1] * height_px)[:, None] / long_px
        if self.kind == "circle":
            return np.asarray(np.hypot(x, y) < self.radius)
        if self.kind == "octagon":
            return np.asarray((np.maximum(x, y) < self.radius) & (x + y < np.sqrt(2) * self.radius))
        return np.ones((height_px, width_px), np.bool_)


@dataclass(frozen=True)
class Exposure:
    """Exposure over time: constant, two oscillations, or automatic with a delay."""

    kind: Literal["constant", "drift", "automatic"] = "constant"
    stops: tuple[float, float] = (0.0, 0.0)
    """Amplitudes of the oscillations in stops (factors of two)."""
    periods_s: tuple[float, float] = (1.9, 3.1)
    gain: float = 0.0
    """Share of a change of the light's irradiance that the automatic exposure compensates."""
    delay_s: float = 0.0
    """Delay of the automatic exposure, in seconds."""


@dataclass(frozen=True)
class Sensor:
    """Properties of the camera that turns radiance into pictures."""

    field: Field = Field()
    exposure: Exposure = Exposure()
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """White balance: factors on red, green and blue."""
    contrast: float = 1.45
    """Factor on the radiance in the tone curve (`develop`), its slope in the dark."""
    blur_px: float = 0.0
    """Standard deviation of the lens blur, in pixels of a picture 320 pixels wide."""
    shot_noise: float = 0.0
    """Standard deviation of the noise at radiance 1, growing with the root of the radiance."""
    read_noise: float = 0.0
    """Standard deviation of the noise in the dark, in radiance."""
    sharpening: float = 0.0
    """Strength of the camera's unsharp mask: factor on the difference from a blurred picture, which is added."""
    quality: int | None = None
    """JPEG quality of the compression; None for none."""

    def picture(self, radiance: Array, random: Random) -> NDArray[np.uint8]:
        """Turn radiance [H, W, 3] after the exposure into a picture.

        Args:
            radiance: linear radiance at the sensor.
            random: generator of the noise.
        """
        height, width = radiance.shape[:2]
        scale = max(height, width) / 320
        seen = np.asarray(radiance * np.array(self.white, np.float32), np.float32)
        if self.blur_px:
            seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), self.blur_px * scale), np.float32)
        if self.field.kind != "full":
            inside = self.field.mask(width, height).astype(np.float32)
            seen *= cv2.GaussianBlur(inside, (0, 0), 0.7 * scale)[..., None]
        if self.shot_noise or self.read_noise:
            spread = np.sqrt(self.read_noise**2 + self.shot_noise**2 * np.maximum(seen, 0))
            seen = np.maximum(seen + spread * random.standard_normal(seen.shape, np.float32), 0)
        image = develop(seen, self.contrast)
        if self.sharpening:
            soft = cv2.GaussianBlur(image, (0, 0), 1.2 * scale)
            image = np.asarray(cv2.addWeighted(image, 1 + self.sharpening, soft, -self.sharpening, 0), np.uint8)
        if self.quality is not None:
            encoded, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.quality])
            assert encoded
            decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
            assert decoded is not None
            image = np.ascontiguousarray(decoded[..., ::-1], np.uint8)
        return image
