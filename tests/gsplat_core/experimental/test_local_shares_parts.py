"""Shares of guesses, against closed-form ridge regression of one number."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.experimental.learned_prior import LocalShares, SharesSettings, cells_for
from gsplat_core.training.initialisation import blur_sigma_px, jittered_grid
from gsplat_core.training.observations import unprojected

SETTINGS = SharesSettings(at_first=(0.6,), decay=0.5, around_cells=2.0, pull=3.0, ridge=0.25)


def field(value):
    return np.full((20, 30, 2), value, np.float32)


def test_local_shares_whole_regularised_towards_initial_share():
    shares = LocalShares(SETTINGS)
    assert shares.whole() == [0.6]
    weight = np.full((20, 30), 0.5, np.float32)
    shares.learn([field(2.0)], field(1.0), weight)  # products 4 and 2, half of which counts
    assert shares.whole() == pytest.approx([(1 + 0.25 * 0.6) / (2 + 0.25)])
    shares.learn([field(2.0)], field(2.0), weight)
    assert shares.whole() == pytest.approx([(2 + 0.5 * 1 + 0.15) / (2 + 0.5 * 2 + 0.25)])


def test_local_shares_regularised_towards_whole_share():
    shares = LocalShares(SETTINGS)
    came = field(1.0)
    came[:, 15:] = 3.0
    shares.learn([field(2.0)], came, np.ones((20, 30), np.float32))
    whole = (4 + 0.15) / 4.25
    assert shares.whole() == pytest.approx([whole])
    local = shares.local((20, 30))[..., 0]
    assert local[10, 2] == pytest.approx((2 + 3 * whole) / 7, abs=1e-3)
    assert local[10, 27] == pytest.approx((6 + 3 * whole) / 7, abs=1e-3)


@pytest.mark.parametrize(("shape", "cells"), [((20, 30), (30, 20)), ((40, 40), (40, 40)), ((60, 80), (40, 30)), ((1, 400), (40, 1))])  # fmt: skip
def test_cells_limited_to_forty_along_longer_side(shape, cells):
    assert cells_for(shape) == cells


@pytest.mark.parametrize(("spacing", "sigma"), [(0.5, 0.3), (1.0, 0.3), (10.0, 3.0)])
def test_blur_sigma_by_grid_spacing(spacing, sigma):
    assert blur_sigma_px(spacing) == pytest.approx(sigma)


def test_jittered_grid_covers_image_evenly():
    pixels, spacing = jittered_grid(80, 60, 48, 0)
    assert spacing == 10 and pixels.shape == (48, 2)
    off = pixels.reshape(6, 8, 2) - np.stack(np.meshgrid(np.arange(8) * 10 + 5.0, np.arange(6) * 10 + 5.0), -1)
    assert 1.2 < np.abs(off).max() <= 1.5  # 0.15 of the spacing to each side
    np.testing.assert_array_equal(pixels, jittered_grid(80, 60, 48, 0)[0])


def test_unprojected_points_and_pixel_length_per_camera_model():
    from gsplat_core.scene.cameras import Camera

    K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
    pixel, z = np.array([[70.0, 30.0]]), np.array([50.0])
    expected = {
        "pinhole": (15.0, 0.5),
        "ortho": (0.3, 0.01),
        # At an angle of 0.3: z tan outwards, and the mean of z / cos² and z tan / angle for a pixel.
        "fisheye": (50 * np.tan(0.3), 0.5 * np.sqrt(np.tan(0.3) / 0.3) / np.cos(0.3)),
    }
    for model, (x, pixel_mm) in expected.items():
        points, length = unprojected(pixel, z, Camera(K, 80, 60, np.eye(4), model=model))
        np.testing.assert_allclose(points, [[x, 0, 50]])
        np.testing.assert_allclose(length, [pixel_mm])
