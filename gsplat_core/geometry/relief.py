"""Shading model of a relief lit by the scope's own lamp: brightness and highlights with
derivatives.

The logarithm of depth is a sum of cosines along the picture's sides: u = Σ c_k cos_k, z = exp(u). A
surface lit by a small lamp at the camera's centre has the brightness cos θ / r², where θ is the
angle between its normal and the ray and r the distance along the ray. With x = X / z, y = Y / z and
partial derivatives ∂x, ∂y this is exactly

    r² = z² (1 + x² + y²),   cos θ = 1 / (√(1 + x² + y²) |N|),   N = (-∂x u, -∂y u, 1 + x ∂x u + y
        ∂y u)

(Prados and Faugeras 2005). Wet tissue shows highlights where its normal points to the lamp, that is
where θ is small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera

Array = NDArray[np.float64]

HALF_WAVES = 9
"""Half periods of the finest cosine along the longer side."""
SOFTNESS = 0.25
"""Fill light by subsurface scattering and surrounding walls: cos θ is replaced by (cos θ +
SOFTNESS) / (1 + SOFTNESS).
"""
ROUND = 0.1
"""Angle in radians below which differences hardly affect highlights, since fine bumps are never all
level.
"""


@dataclass(frozen=True)
class Grid:
    """Cell grid of a picture with the intrinsics of its rays."""

    height: int
    width: int
    focal: tuple[float, float]
    """Focal lengths along rows and columns, in cells."""
    centre: tuple[float, float]
    """Principal point, in cells."""

    @classmethod
    def of(cls, camera: Camera, shape: tuple[int, ...]) -> Grid:
        """Return the grid of `shape` [h, w] over the whole picture of a pinhole camera."""
        across, down = shape[1] / camera.width_px, shape[0] / camera.height_px
        focal = float(camera.K[0, 0]) * across, float(camera.K[1, 1]) * down
        return cls(shape[0], shape[1], focal, (float(camera.K[0, 2]) * across, float(camera.K[1, 2]) * down))

    @property
    def waves(self) -> list[tuple[int, int, float]]:
        """Half periods of each cosine down and across, and along the longer side. The constant is
        excluded.
        """
        longer = max(self.height, self.width)
        all_waves = ((j, i) for j in range(HALF_WAVES) for i in range(HALF_WAVES))
        counted = [(j, i, float(np.hypot(i * longer / self.width, j * longer / self.height))) for j, i in all_waves]
        return [(j, i, count) for j, i, count in counted if 0 < count <= HALF_WAVES]

    @property
    def half_waves(self) -> Array:
        """Half periods of each cosine along the longer side, float64 [cosines]."""
        return np.array([count for _, _, count in self.waves])

    def middles(self) -> tuple[Array, Array]:
        """Return columns and rows of the cell centres [h, w], in cells."""
        column, row = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return column, row


@dataclass(frozen=True)
class Places:
    """Positions in a picture with the values and derivatives of the cosines there."""

    x: Array
    """X / z of the ray, [places]."""
    y: Array
    value: Array
    """Values of the cosines, [places, cosines]."""
    by_x: Array
    """Derivatives of the cosines by x, [places, cosines]."""
    by_y: Array

    @classmethod
    def at(cls, grid: Grid, column: Array, row: Array) -> Places:
        """Evaluate the cosines at columns and rows of any shape, in cells."""
        column, row = column.ravel(), row.ravel()
        order = np.arange(HALF_WAVES)
        across, down = (
            np.pi * order * (each / side)[:, None] for each, side in ((column, grid.width), (row, grid.height))
        )
        j, i = (np.array(part) for part in zip(*((j, i) for j, i, _ in grid.waves), strict=True))
        cos_across, cos_down = np.cos(across)[:, i], np.cos(down)[:, j]
        by_column = -np.sin(across)[:, i] * (np.pi / grid.width * i)
        by_row = -np.sin(down)[:, j] * (np.pi / grid.height * j)
        return cls(
            (column - grid.centre[0]) / grid.focal[0],
            (row - grid.centre[1]) / grid.focal[1],
            cos_across * cos_down,
            by_column * cos_down * grid.focal[0],
            cos_across * by_row * grid.focal[1],
        )

    @property
    def axis(self) -> Array:
        """Logarithm of the cosine of the rays' angle to the optical axis, [places]."""
        return np.asarray(-0.5 * np.log1p(self.x**2 + self.y**2))


@dataclass(frozen=True)
class Appearance:
    """Appearance of a relief and its derivatives by the coefficients [places, cosines]."""

    lit: Array
    """Logarithm of brightness [places]."""
    lit_by: Array
    angle: Array
    """Angle between normal and ray [places], approximately in radians and rounded off near zero
    (`ROUND`).
    """
    angle_by: Array


def appearance(places: Places, coefficients: Array, slopes: float = 1.0) -> Appearance:
    """Compute the appearance of a relief.

    Args:
        places: positions.
        coefficients: float64 [cosines].
        slopes: weight of the cosine term in brightness, from 0 (distance only) to 1.
    """
    x, y, axis = places.x, places.y, places.axis
    u, u_x, u_y = (basis @ coefficients for basis in (places.value, places.by_x, places.by_y))
    towards = 1 + x * u_x + y * u_y
    squared = u_x**2 + u_y**2 + towards**2
    cosine = np.exp(axis) / np.sqrt(squared)
    # Derivative of log cos θ.
    turned = ((u_x + towards * x) / squared)[:, None] * places.by_x + ((u_y + towards * y) / squared)[
        :, None
    ] * places.by_y
    gain = slopes * cosine / (cosine + SOFTNESS)
    lit = -2 * u + slopes * np.log((cosine + SOFTNESS) / (1 + SOFTNESS)) + 2 * axis
    chord = np.sqrt(np.maximum(2 - 2 * cosine, 0) + ROUND**2)
    return Appearance(
        lit, -2 * places.value - gain[:, None] * turned, chord - ROUND, (cosine / chord)[:, None] * turned
    )
