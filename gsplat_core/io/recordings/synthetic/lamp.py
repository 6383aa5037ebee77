"""Light source of the scope: two fibres at its tip, in the coordinates of the rendering camera.

Irradiance falls with the squared distance to a fibre, with the cosine between surface normal and light direction, and
with the angle from the beam axis. No other light exists, so near tissue is bright and far tissue dark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

LIGHTS_MM = ((-3.2, -2.2, 0.0), (3.2, -2.2, 0.0))
"""Positions of the two light fibres in mm, around the centre of the scope's tip."""
REFERENCE_MM = 66.0
"""Distance in mm at which a white surface facing the scope has radiance 1."""
SHADOW_MM = (0.0, -7.0, 0.0)
"""Origin of the shadow rays, above the fibres so that shadows are not hidden behind the tool."""


@dataclass(frozen=True)
class LampPlan:
    """Positions of the fibres in mm around the centre of the scope's tip, and width of their beam."""

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
    """Reference distance in mm that sets the exposure."""
    beam: float = 2.0
    """Exponent of the cosine of the angle from the beam axis."""

    @classmethod
    def of_eye(cls, scope_x_mm: float, reference_mm: float = REFERENCE_MM, plan: LampPlan = USUAL_LAMP) -> Lamp:
        """Return the light source for an eye that looks in the scope's direction.

        Args:
            scope_x_mm: x coordinate of the centre of the scope's tip.
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
