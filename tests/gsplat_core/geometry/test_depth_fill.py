"""Depth where none is known: planes go on, and nothing runs away."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth.plane_fits import filled_depth, local_plane

HEIGHT, WIDTH = 96, 128


def tilted(slope: float = 0.3) -> np.ndarray:
    """The depth of a plane: its inverse is linear in the picture."""
    x = np.linspace(-1, 1, WIDTH, dtype=np.float32)
    return np.repeat((60 / (1 + slope * x))[None], HEIGHT, axis=0).astype(np.float32)


def off(found: np.ndarray, true: np.ndarray, where: np.ndarray) -> float:
    return float(np.abs(found / true - 1)[where].max())


def test_filled_depth_continues_plane_below_tool():
    depth, known = tilted(), np.ones((HEIGHT, WIDTH), bool)
    known[30:60, 50:90] = False
    depth[~known] = 7.0
    found = filled_depth(depth, known)
    assert off(found, tilted(), ~known) < 0.01 and off(found, tilted(), known) < 0.03


def test_filled_depth_continues_plane_beyond_stereo_edge():
    known = np.ones((HEIGHT, WIDTH), bool)
    known[:, :16] = False
    nearest = tilted()[:, 16]
    found = filled_depth(tilted(), known)
    assert off(found, tilted(), ~known) < 0.4 * off(np.repeat(nearest[:, None], WIDTH, 1), tilted(), ~known)


def test_filled_depth_without_known_pixels_is_zero():
    assert not filled_depth(tilted(), np.zeros((HEIGHT, WIDTH), bool)).any()


@pytest.mark.parametrize("pixel", [(0, 0), (HEIGHT - 1, WIDTH - 1), (40, 60)])
def test_filled_depth_of_one_known_pixel_is_constant(pixel):
    known = np.zeros((HEIGHT, WIDTH), bool)
    known[pixel] = True
    assert filled_depth(tilted(), known) == pytest.approx(np.full((HEIGHT, WIDTH), tilted()[pixel]), rel=0.01)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (33, 1), (5, 3)])
def test_filled_depth_of_any_picture_size(shape):
    found = filled_depth(np.full(shape, 50, np.float32), np.ones(shape, bool))
    assert found.shape == shape and found == pytest.approx(np.full(shape, 50), rel=1e-3)


def test_filled_depth_is_bounded_by_known_depth():
    rng = np.random.default_rng(0)
    known = np.zeros((HEIGHT, WIDTH), bool)
    known[:6, :6] = True
    noisy = rng.uniform(40, 80, (HEIGHT, WIDTH)).astype(np.float32)
    found = filled_depth(noisy, known)
    assert found.min() >= 20 and found.max() <= 160 and np.isfinite(found).all()


def test_local_plane_weights_single_cell_by_window_share():
    """The middle of a window of 2 cells weighs 1 / (2 pi 2²) = 0.0398, twice the weight of half confidence."""
    values, weight = np.zeros((21, 21), np.float32), np.zeros((21, 21), np.float32)
    values[10, 10], weight[10, 10] = 0.6, 1.0
    share = 1 / (2 * np.pi * 4)
    found = local_plane(values, weight, 2.0)
    assert found[10, 10] == pytest.approx(0.6 * share / (share + 0.02), rel=0.01)
    assert abs(found[10, 13]) < abs(found[10, 10])


@pytest.mark.parametrize(("slope", "bound"), [(0.9, 2.0), (-0.9, 2.0)])
def test_filled_depth_extrapolates_by_factor_two_at_most(slope, bound):
    depth, known = tilted(slope), np.zeros((HEIGHT, WIDTH), bool)
    known[:, 56:72] = True
    found = filled_depth(depth, known)
    nearest, farthest = depth[known].min(), depth[known].max()
    assert found.min() >= nearest / bound * 0.97 and found.max() <= farthest * bound * 1.03
