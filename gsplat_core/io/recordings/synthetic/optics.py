"""Optics of a synthetic scope: its lamp, the smoke and particles in front of it, its lens and its camera.

The lamp has two fibres at the tip of the scope, in the coordinates of the rendering camera. Irradiance falls with the
squared distance to a fibre, with the cosine between surface normal and light direction, and with the angle from the beam
axis. No other light exists, so near tissue is bright and far tissue dark.

The lens distorts, and may show a round or octagonal field of view. The camera varies its exposure and adds noise and compression.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera

Array = NDArray[np.floating]

LIGHTS_MM = ((-3.2, -2.2, 0.0), (3.2, -2.2, 0.0))
"""Positions of the two light fibres in mm, around the centre of the scope's tip."""
REFERENCE_MM = 66.0
"""Distance from the lamp in mm at which a white surface facing the scope has radiance 1; sets the exposure."""
SHADOW_MM = (0.0, -7.0, 0.0)
"""Origin of the shadow rays, above the fibres so that shadows are not hidden behind the tool."""


@dataclass(frozen=True)
class LampPlan:
    """Positions of the fibres in mm relative to the centre of the scope's tip, and how narrow their beam is."""

    lights_mm: tuple[tuple[float, float, float], tuple[float, float, float]] = LIGHTS_MM
    beam: float = 2.0
    """Exponent of the cosine of the angle from the beam axis; larger values darken the picture's corners."""


USUAL_LAMP = LampPlan()


@dataclass(frozen=True)
class Lamp:
    """Geometry of the light source in mm, in the coordinates of the rendering camera."""

    fibres: Array
    """Positions of the two light fibres in mm, [2, 3]."""
    axis: Array
    """Beam axis, a unit vector [3]."""
    shadow_from: Array
    """Origin of the shadow rays in mm, [3]."""
    reference_mm: float = REFERENCE_MM
    """Distance in mm at which a white surface facing the lamp has radiance 1; sets the exposure."""
    beam: float = 2.0
    """Exponent of the cosine of the angle from the beam axis."""

    @classmethod
    def of_eye(cls, scope_x_mm: float, reference_mm: float = REFERENCE_MM, plan: LampPlan = USUAL_LAMP) -> Lamp:
        """Return the light source in the coordinates of an eye that looks in the scope's direction.

        Args:
            scope_x_mm: x coordinate of the centre of the scope's tip, in the eye's coordinates.
            reference_mm: distance at which a white surface has radiance 1.
            plan: positions and beam of the fibres.
        """
        fibres = np.array(plan.lights_mm, np.float32) + np.array([scope_x_mm, 0, 0], np.float32)
        above = fibres.mean(axis=0) + np.array(SHADOW_MM, np.float32)
        return cls(fibres, np.array([0, 0, 1], np.float32), above, reference_mm, plan.beam)

    def seen_from(self, eye_to_view: NDArray[np.float64]) -> Lamp:
        """Return the light source in the coordinates of another camera.

        Args:
            eye_to_view: rigid transform [4, 4] from the current camera to the other one.
        """
        rotation, translation = eye_to_view[:3, :3], eye_to_view[:3, 3]
        moved = lambda points: (points @ rotation.T + translation).astype(np.float32)
        axis = (rotation @ self.axis).astype(np.float32)
        return replace(self, fibres=moved(self.fibres), axis=axis, shadow_from=moved(self.shadow_from))

    def rays_to(self, points: Array, nearest_mm2: float = 0.0) -> list[tuple[Array, Array]]:
        """Return, for each fibre, the light direction and irradiance at points [..., 3].

        The irradiance excludes the cosine at the surface.

        Args:
            points: positions in mm.
            nearest_mm2: squared distance in mm² below which the irradiance is constant.

        Returns:
            For each fibre, unit vectors to the fibre [..., 3] and irradiance [...].
        """
        found = []
        for fibre in self.fibres:
            to_light = fibre - points
            distance2 = np.einsum("...i,...i->...", to_light, to_light)
            to_light /= np.sqrt(distance2)[..., None]
            if nearest_mm2:
                distance2 = np.maximum(distance2, np.float32(nearest_mm2))
            along = np.clip(-(to_light @ self.axis), 0, 1)
            # A fibre's light falls off with the angle from the beam axis.
            found.append((to_light, np.float32(0.5 * self.reference_mm**2) / distance2 * along**self.beam))
        return found


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
"""Amplitudes of the exposure's oscillations in stops (factors of two), one for each period of `EXPOSURE_PERIODS_S`."""


@dataclass(frozen=True)
class Air:
    """Smoke and exposure as functions of time."""

    smoke: float
    """Strength of the smoke: 0 for none, 1 for dense smoke."""
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
        """Return the exposure factor at a time; 1 at time 0, and always for a constant exposure."""
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
            # Illuminate smoke like a white surface half-way to the tissue, scaled down because smoke is thin.
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


NEAREST_PARTICLE_MM = 6.0
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
    """Velocities of the particles in mm/s, [N, 3]."""
    radii_mm: NDArray[np.float64]
    """Radii of the particles in mm, [N]."""
    whiteness: NDArray[np.float64]
    """Reflectances of the particles, 0..1, [N]."""
    box_mm: tuple[float, float, float]
    """Size of the box in mm along x, y and z. It starts at the scope's plane at time 0 and is centred on its axis."""

    @classmethod
    def drawn(cls, random: np.random.Generator, count: int, size_mm: float, distance_mm: float) -> Particles:
        """Draw particles for tissue at a distance.

        Args:
            random: generator.
            count: number of particles.
            size_mm: median radius in mm.
            distance_mm: distance of the tissue in mm.
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
            if at[2] < NEAREST_PARTICLE_MM:
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
    """Share of a change of the lamp's irradiance on the tissue that the automatic exposure compensates."""
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
