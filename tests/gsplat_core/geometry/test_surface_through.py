"""A smooth surface through scattered points."""

from __future__ import annotations

import numpy as np

from gsplat_core.depth.plane_fits import surface_through

SIZE = 90, 121


def points(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (count, 2)) * [SIZE[1], SIZE[0]]


def plane_at(pixels: np.ndarray) -> np.ndarray:
    return 1 / (0.02 + 1e-5 * pixels[..., 0] - 2e-5 * pixels[..., 1])


def test_surface_through_plane_points_extrapolates_plane() -> None:
    pixels = points(500)
    pixels = pixels[pixels[:, 0] < 90]
    depth, error, support = surface_through(pixels, plane_at(pixels), np.full(len(pixels), 0.01), SIZE)
    assert depth.shape == error.shape == support.shape == SIZE
    grid = np.stack(np.meshgrid(np.arange(SIZE[1]) + 0.5, np.arange(SIZE[0]) + 0.5), 2)
    np.testing.assert_allclose(depth[:, :100], plane_at(grid)[:, :100], rtol=0.01)
    np.testing.assert_allclose(error[:, :80], 0.01, rtol=1e-6)
    assert (support[8:-8, 8:80] > 0.9).all()
    assert (support[:, -5:] < 0.2).all()


def test_surface_through_downweights_uncertain_points() -> None:
    pixels = np.tile(points(800), (2, 1))
    depth, error = np.repeat([50.0, 60.0], 800), np.repeat([0.005, 0.2], 800)
    found, of_found, _ = surface_through(pixels, depth, error, SIZE)
    assert np.abs(found - 50).max() < 0.2
    assert of_found.max() < 0.02


def test_surface_through_few_or_no_points_is_finite() -> None:
    for count in (0, 1, 2):
        pixels = points(count)
        depth, _, support = surface_through(pixels, np.full(count, 30.0), np.full(count, 0.01), SIZE)
        assert np.isfinite(depth).all()
        assert (depth > 0).all()
        assert support.max() <= 1
        assert np.median(support) < 0.1
    outside = np.array([[-3.0, 5.0], [500.0, 5.0]])
    assert surface_through(outside, np.array([30.0, 40.0]), np.array([0.01, 0.01]), SIZE)[2].max() == 0
