"""Deforming tissue: a smooth sheet of material points (u, v) with motion and colour.

Texture is looked up by (u, v), the point's position on the undeformed sheet, so it moves with the tissue. Lengths are
in millimetres and times in seconds. World axes are those of the camera at rest (x right, y down, z away).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.recordings.calibration import DEFAULT_FOCAL_FACTOR
from gsplat_core.io.recordings.synthetic.breathing import Breathing
from gsplat_core.io.recordings.synthetic.lamp import REFERENCE_MM
from gsplat_core.io.recordings.synthetic.texture import TissueTexture

Array = NDArray[np.floating]

TISSUE_DISTANCE_MM = 74.0
PULSE_PERIOD_S = 0.9
TUG_RADIUS_MM = 12.0


@dataclass(frozen=True)
class Tug:
    """Local displacement by a tool: `pull` at the material point `grasp` with a Gaussian falloff."""

    grasp: tuple[float, float]
    pull: tuple[float, float, float]


NO_TUG = Tug((0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class SurfacePoints:
    """Positions and tangents of material points: each a tuple of x, y and z arrays."""

    position: tuple[Array, Array, Array]
    along_u: tuple[Array, Array, Array]
    along_v: tuple[Array, Array, Array]


class Tissue:
    """One patient's sheet of tissue at the bottom of an open cavity: shape, breathing, pulse, colour.

    Deterministic for a given random generator. Subclasses override the shape at rest.
    """

    focal_factor = DEFAULT_FOCAL_FACTOR
    """Focal length of the scene's camera over the longer side of its pictures."""
    exposed_mm = REFERENCE_MM
    """Reference distance in mm that sets the exposure; see `lamp.REFERENCE_MM`."""
    looked_at_mm = TISSUE_DISTANCE_MM
    """Distance in mm of the point that a moving scope keeps at the centre of its view."""
    sway_mm = (7.0, 4.5, 6.0)
    """Amplitudes in mm of a moving scope's sway along x, y and z."""
    tools = True
    """True if the scene contains a tool."""

    def __init__(self, rng: np.random.Generator, texel_mm: float) -> None:
        wavelengths = np.array([74.0, 58.0, 43.0, 33.0, 26.0, 21.0])
        slopes = np.array([0.16, 0.17, 0.15, 0.14, 0.10, 0.07])
        angles = rng.uniform(0, 2 * np.pi) + np.arange(6) * 2.4 + rng.uniform(-0.4, 0.4, 6)
        wave_numbers = 2 * np.pi / wavelengths
        self._relief = [
            (float(k * np.cos(angle)), float(k * np.sin(angle)), float(phase), float(slope / k))
            for k, angle, phase, slope in zip(wave_numbers, angles, rng.uniform(0, 2 * np.pi, 6), slopes, strict=True)
        ]
        self._tilt = rng.uniform(-0.10, 0.10, 2)
        self.breathing = Breathing(float(rng.uniform(0, 2 * np.pi)))
        """Default; replaced if a recording requests other breathing."""
        self._breath_angle = float(rng.uniform(0, 2 * np.pi))
        self.texture = TissueTexture(rng, texel_mm)

    def first_guess(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Return start values of Newton's method for the ray intersections.

        The rays from `origin` [3] along `directions` [H, W, 3] are intersected with the plane at the mean distance.
        """
        s = (np.float32(TISSUE_DISTANCE_MM) - origin[2]) / directions[..., 2]
        return origin[0] + s * directions[..., 0], origin[1] + s * directions[..., 1]

    def _at_rest(self, u: Array, v: Array) -> SurfacePoints:
        """Return undeformed positions of the material points (u, v) and their derivatives by u and v."""
        one, zero = np.ones_like(u), np.zeros_like(u)
        bowl = np.float32(-0.0022)
        tilt_u, tilt_v = (np.float32(tilt) for tilt in self._tilt)
        z = np.float32(TISSUE_DISTANCE_MM) + tilt_u * u + tilt_v * v + bowl * (u * u + v * v)
        z_u, z_v = tilt_u + 2 * bowl * u, tilt_v + 2 * bowl * v
        for k_u, k_v, phase, amplitude in self._relief:
            angle = np.float32(k_u) * u + np.float32(k_v) * v + np.float32(phase)
            z = z + np.float32(amplitude) * np.sin(angle)
            slope = np.float32(amplitude) * np.cos(angle)
            z_u, z_v = z_u + np.float32(k_u) * slope, z_v + np.float32(k_v) * slope
        return SurfacePoints((u, v, z), (one, zero, z_u), (zero, one, z_v))

    def points(self, u: Array, v: Array, time_s: float, tug: Tug) -> SurfacePoints:
        """Return positions of the material points (u, v) at a time and their derivatives by u and v."""
        rest = self._at_rest(u, v)
        (x, y, z), (x_u, y_u, z_u), (x_v, y_v, z_v) = rest.position, rest.along_u, rest.along_v

        # Breathing: a long wave that lifts and shears; pulse: a short one that runs across.
        breath = self.breathing.phase(time_s)
        pulse = 2 * np.pi * time_s / PULSE_PERIOD_S
        direction = (np.cos(self._breath_angle), np.sin(self._breath_angle))
        for wavelength_mm, phase, lift_mm, shear_mm in ((130.0, breath, 2.4, 1.6), (55.0, -pulse, 0.35, 0.25)):
            wave_u, wave_v = (np.float32(2 * np.pi / wavelength_mm * component) for component in direction)
            angle = wave_u * u + wave_v * v + np.float32(phase)
            sine, cosine = np.sin(angle), np.cos(angle)
            lift, shear = np.float32(lift_mm), np.float32(shear_mm)
            z, z_u, z_v = z + lift * sine, z_u + lift * wave_u * cosine, z_v + lift * wave_v * cosine
            for axis, component in enumerate(direction):
                part = shear * np.float32(component)
                if axis == 0:
                    x, x_u, x_v = x + part * cosine, x_u - part * wave_u * sine, x_v - part * wave_v * sine
                else:
                    y, y_u, y_v = y + part * cosine, y_u - part * wave_u * sine, y_v - part * wave_v * sine

        # The tug.
        inverse = np.float32(1 / TUG_RADIUS_MM**2)
        d_u, d_v = u - np.float32(tug.grasp[0]), v - np.float32(tug.grasp[1])
        weight = np.exp(np.float32(-0.5) * inverse * (d_u * d_u + d_v * d_v))
        w_u, w_v = -inverse * d_u * weight, -inverse * d_v * weight
        p_x, p_y, p_z = (np.float32(component) for component in tug.pull)
        return SurfacePoints(
            (x + p_x * weight, y + p_y * weight, z + p_z * weight),
            (x_u + p_x * w_u, y_u + p_y * w_u, z_u + p_z * w_u),
            (x_v + p_x * w_v, y_v + p_y * w_v, z_v + p_z * w_v),
        )

    def position(self, point: tuple[float, float], time_s: float, tug: Tug) -> NDArray[np.float64]:
        """Return the position [3] in mm of one material point (u, v) at a time."""
        u, v = point
        points = self.points(np.array([u], np.float32), np.array([v], np.float32), time_s, tug)
        return np.array([float(component[0]) for component in points.position])
