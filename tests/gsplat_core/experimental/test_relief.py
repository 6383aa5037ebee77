"""Brightness of a relief compared with a surface rendered from its points and normals, and its derivatives with finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.experimental.light import ROUND, SOFTNESS, Grid, Places, appearance
from gsplat_core.scene.cameras import Camera

CAMERA = Camera.from_focal(140.0, 160, 128)
GRID = Grid.of(CAMERA, (32, 40))


def coefficients(seed, size=0.1):
    return np.random.default_rng(seed).normal(0, size, len(GRID.half_waves)) / (1 + GRID.half_waves**2)


def test_relief_grid_aligned_with_image():
    assert (GRID.focal, GRID.centre) == ((35.0, 35.0), (20.0, 16.0))
    assert GRID.half_waves.min() == 1 and GRID.half_waves.max() <= 9


@pytest.mark.parametrize("seed", range(3))
def test_relief_brightness_and_angle_equal_surface(seed):
    column, row = np.random.default_rng(seed).uniform([[2], [2]], [[38], [30]], (2, 50))
    found = coefficients(seed)

    def points(right=0.0, down=0.0):
        places = Places.at(GRID, column + right, row + down)
        z = 60 * np.exp(places.value @ found)
        return np.stack([places.x * z, places.y * z, z], axis=1)

    normal = np.cross(points(right=1e-5) - points(right=-1e-5), points(down=1e-5) - points(down=-1e-5))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distance = np.linalg.norm(points(), axis=1)
    facing = np.einsum("ni,ni->n", normal, points()) / distance
    shown = appearance(Places.at(GRID, column, row), found)
    lit = np.log((facing + SOFTNESS) / (1 + SOFTNESS)) - 2 * np.log(distance / 60)
    assert np.allclose(shown.lit, lit, atol=1e-6)
    assert np.allclose(shown.angle, np.sqrt(2 - 2 * facing + ROUND**2) - ROUND, atol=1e-6)


@pytest.mark.parametrize("slopes", [0.0, 0.4, 1.0])
def test_relief_derivatives_equal_finite_differences(slopes):
    places, found = Places.at(GRID, *GRID.middles()), coefficients(5, 0.4)
    shown = appearance(places, found, slopes)
    for number in (0, 1, 7, len(found) - 1):
        step = np.zeros(len(found))
        step[number] = 1e-5
        above, below = (appearance(places, found + way * step, slopes) for way in (1, -1))
        assert np.allclose(shown.lit_by[:, number], (above.lit - below.lit) / 2e-5, atol=1e-5)
        assert np.allclose(shown.angle_by[:, number], (above.angle - below.angle) / 2e-5, atol=1e-5)
