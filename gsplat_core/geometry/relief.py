"""Shape from shading, for a light at the camera: the relief of a surface from how brightly it is lit (Prados and Faugeras 2005).

Logarithms of depth are a sum of cosines along the picture's sides: u = Σ c_k cos_k, z = exp(u). A surface in the light of a small lamp at the
camera's centre has the brightness cos θ / r², for the angle θ between its normal and the ray, and the distance r along the ray. With x = X / z
and y = Y / z that is, without approximation (∂ are derivatives by x and y):

    r² = z² (1 + x² + y²),   cos θ = 1 / (√(1 + x² + y²) |N|),   N = (-∂x u, -∂y u, 1 + x ∂x u + y ∂y u)

Unknown beside the relief are how much light there is, how the lamp and the lens darken towards the border (a power of the cosine of the angle
to the axis), and what is left of the tissue's colour, another sum of cosines. All have Gaussian priors; the width of that of the relief is estimated
from the picture (evidence maximisation, MacKay 1992). The maximum a posteriori is found by Gauss-Newton.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gsplat_core.geometry.shading import Shading

Array = NDArray[np.float64]

HALF_WAVES = 9
"""Half periods of the finest cosine along the longer side."""
RELIEF = 0.05
"""Prior standard deviation of the coefficients of coarse cosines of u ..."""
RELIEF_COUNT = 100
"""... and the weight of that value while the width is estimated: as if so many coefficients had shown it."""
SMALLEST_RELIEF, LARGEST_RELIEF = 0.025, 2.0
RELIEF_HALF_WAVES, RELIEF_POWER = 1.5, 4.0
"""Prior standard deviations fall with finer cosines as (1 + (half waves / RELIEF_HALF_WAVES)²) to the power of -RELIEF_POWER / 2."""
PIGMENT = 0.5
"""Prior standard deviation of the coefficients of coarse cosines of the pigment that is left, in units of `Shading.detail` ..."""
PIGMENT_HALF_WAVES = 2.0
"""... and from how many half waves on it falls, with their square."""
FALL_OFF, FALL_OFF_DEVIATION = 1.0, 0.5
"""Prior of the power of the cosine to the axis by which it darkens towards the border: 1 for a flat lamp."""
SOFTNESS = 0.25
"""Subsurface scattering and light from the walls around also reach slopes that face away: (cos θ + SOFTNESS) / (1 + SOFTNESS) in place of cos θ."""
UNREMOVED_PIGMENT = 0.05
"""Standard deviation in log brightness of large patches of pigment that no weights of the channels remove."""
ROUNDS = 10
ROUNDS_TO_SLOPES = 4
"""Over these the cosine term is faded in: by distance alone brightness is linear in the unknowns, and the later rounds start from that solution."""


@dataclass(frozen=True)
class Cosines:
    """Cosines on a grid of cells, but for the constant one."""

    value: Array
    """[cells, cosines]."""
    along_column: Array
    """Derivative by the column, counted in cells."""
    along_row: Array
    half_waves: Array
    """[cosines], along the longer side."""


@dataclass(frozen=True)
class Relief:
    """What was found in one picture."""

    coefficients: Array
    """Of the cosines."""
    share: float
    """How much of the relief to believe, 0 to 1: the variance of log brightness by distance, over that plus the one by pigment (`UNREMOVED_PIGMENT`)."""


@lru_cache(maxsize=8)
def cosines(height: int, width: int) -> Cosines:
    """Those of a grid [height, width]."""
    row, column, longer = (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, max(height, width)
    waves = [(j, i) for j in range(HALF_WAVES) for i in range(HALF_WAVES)]
    counted = [(j, i, float(np.hypot(i * longer / width, j * longer / height))) for j, i in waves]
    kept = [(j, i, count) for j, i, count in counted if 0 < count <= HALF_WAVES]
    value, by_column, by_row = [], [], []
    for j, i, _ in kept:
        down, across = np.cos(np.pi * j * row), np.cos(np.pi * i * column)
        value.append(np.outer(down, across).ravel())
        by_column.append(np.outer(down, -np.pi * i / width * np.sin(np.pi * i * column)).ravel())
        by_row.append(np.outer(-np.pi * j / height * np.sin(np.pi * j * row), across).ravel())
    return Cosines(
        np.array(value).T, np.array(by_column).T, np.array(by_row).T, np.array([count for _, _, count in kept])
    )


def find_relief(shading: Shading, x: Array, y: Array, focal_cells: tuple[float, float]) -> Relief:
    """The most probable relief. x, y: those of the cells' rays [h, w]; focal_cells: focal lengths along rows and columns, in cells."""
    known = np.flatnonzero(shading.known)
    waves = cosines(*shading.brightness.shape)
    seen, x, y = shading.brightness.ravel()[known], x.ravel()[known], y.ravel()[known]
    value = waves.value[known]
    by_x, by_y = waves.along_column[known] * focal_cells[0], waves.along_row[known] * focal_cells[1]
    axis = -0.5 * np.log1p(x * x + y * y)  # logarithm of the cosine to the camera's axis
    count = value.shape[1]
    shape = (1 + (waves.half_waves / RELIEF_HALF_WAVES) ** 2) ** (-RELIEF_POWER / 2)
    pigment = PIGMENT * shading.detail / (1 + waves.half_waves / PIGMENT_HALF_WAVES) ** 2
    noise = 2 * shading.share.ravel()[known] / shading.detail**2

    found = np.zeros(2 * count + 2)
    found[-2:] = np.median(seen), FALL_OFF
    expected = np.zeros_like(found)
    expected[-1] = FALL_OFF
    design = np.concatenate([np.zeros_like(value), value, np.ones((len(known), 1)), axis[:, None]], axis=1)
    width = RELIEF
    for number in range(ROUNDS):
        prior = np.concatenate([(width * shape) ** -2, pigment**-2, [1e-6, FALL_OFF_DEVIATION**-2]])
        u, u_x, u_y = (basis @ found[:count] for basis in (value, by_x, by_y))
        towards = 1 + x * u_x + y * u_y
        squared = u_x**2 + u_y**2 + towards**2
        cosine = np.exp(axis) / np.sqrt(squared)
        slopes = min(1.0, number / ROUNDS_TO_SLOPES)
        lit = -2 * u + slopes * np.log((cosine + SOFTNESS) / (1 + SOFTNESS)) + 2 * axis
        gain = slopes * cosine / (cosine + SOFTNESS) / squared
        design[:, :count] = -2 * value
        design[:, :count] -= (gain * (u_x + towards * x))[:, None] * by_x + (gain * (u_y + towards * y))[:, None] * by_y
        off = seen - lit - design[:, count:] @ found[count:]
        weighted = design * (noise / np.sqrt(1 + off * off * noise))[:, None]
        information = design.T @ weighted + np.diag(prior)
        found = found + np.linalg.solve(information, weighted.T @ off - prior * (found - expected))
        if number > 0:
            width = _width(found[:count] / shape, np.linalg.inv(information).diagonal()[:count] * prior[:count])
    by_distance = float(np.var(2 * (value @ found[:count])))
    return Relief(found[:count], by_distance / (by_distance + UNREMOVED_PIGMENT**2))


def _width(scaled: Array, undecided: Array) -> float:
    """The prior's width that makes what was found most probable; `undecided`: posterior over prior variance of each coefficient."""
    decided = float(np.sum(1 - undecided))
    variance = (float(scaled @ scaled) + RELIEF_COUNT * RELIEF**2) / (decided + RELIEF_COUNT)
    return float(np.clip(np.sqrt(variance), SMALLEST_RELIEF, LARGEST_RELIEF))
