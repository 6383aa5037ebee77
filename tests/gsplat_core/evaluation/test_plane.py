"""The flat baselines of depth, against a search over all tilts."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.evaluation.depth import DepthShareSums, NormalSums, best_plane, flat_depths
from gsplat_core.scene.cameras import Camera, pixel_rays

CAMERA = Camera.from_focal(30.0, 48, 40)
RAYS = pixel_rays(CAMERA)
X, Y = RAYS[..., 0], RAYS[..., 1]

SURFACES = {
    "tilted plane": 40 / (1 - 0.4 * X + 0.3 * Y),
    "bowl": 60 - 25 * (X**2 + Y**2),
    "tube": 8 / np.maximum(np.hypot(X, Y), 0.06),
    "tube off the axis": 10 / np.maximum(np.hypot(X - 0.5, Y + 0.3), 0.05),
    "step": np.where(X > 0.2, 30.0, 120.0),
    "noise": 50 + 20 * np.random.default_rng(4).standard_normal(X.shape).clip(-2, 2),
}


def least_error_by_search(rays: np.ndarray, z: np.ndarray) -> float:
    """Squared error of the best plane: every tilt of a fine grid, each at its best distance, which is linear for a known tilt."""
    best, centre, reach = np.inf, np.zeros(2), 4.0
    for _ in range(10):
        tilts = centre + reach * np.stack(np.meshgrid(*[np.linspace(-1, 1, 41)] * 2), -1).reshape(-1, 2)
        inverse = rays[:, :2] @ tilts.T + 1
        shape = 1 / np.where(inverse > 1e-6, inverse, np.nan)
        distance = (shape * z[:, None]).sum(0) / np.square(shape).sum(0)
        errors = np.square(distance * shape - z[:, None]).sum(0)
        errors = np.where(np.isfinite(errors), errors, np.inf)
        best, centre, reach = min(best, errors.min()), tilts[errors.argmin()], reach / 4
    return float(best)


def squared_error(found: np.ndarray, z: np.ndarray) -> float:
    return float(np.square(found - z).sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_best_fit_plane_has_least_error_of_all_tilts(name: str) -> None:
    rays, z = RAYS.reshape(-1, 3), SURFACES[name].ravel()
    flat = flat_depths(rays, z)
    assert flat is not None
    assert squared_error(flat.plane, z) <= least_error_by_search(rays, z) * (1 + 1e-4) + 1e-6
    assert (
        squared_error(flat.plane, z)
        <= np.square(z - z.mean()).sum() * (1 + 1e-12)
        <= squared_error(flat.level, z) * (1 + 1e-9)
    )
    assert (flat.plane > 0).all()


def test_best_plane_exact_in_any_unit() -> None:
    rays = RAYS.reshape(-1, 3)
    for unit in (1e-4, 1.0, 1e5):
        z = unit * SURFACES["tilted plane"].ravel()
        np.testing.assert_allclose(best_plane(rays, z) * unit, [-0.01, 0.0075, 0.025], rtol=1e-5)


@pytest.mark.parametrize("seed", range(8))
def test_flat_depths_of_few_pixels_never_worse_than_level_plane(seed: int) -> None:
    random = np.random.default_rng(seed)
    count = int(random.integers(3, 9))
    rays = RAYS.reshape(-1, 3)[random.integers(0, X.size, count)]
    z = random.uniform(0.01, 300.0, count)
    flat = flat_depths(rays, z)
    assert flat is not None and np.isfinite(flat.plane).all() and (flat.plane > 0).all()
    assert squared_error(flat.plane, z) <= np.square(z - z.mean()).sum() + 1e-9


def test_best_plane_of_two_pixels_is_none() -> None:
    assert best_plane(RAYS.reshape(-1, 3)[:2], np.ones(2)) is None


def test_depth_baselines_measured_at_pixels_of_model() -> None:
    """A model that covers the near half alone is compared with planes through the near half."""
    true = SURFACES["step"].astype(np.float32)
    shown = np.where(true < 100, true, 0).astype(np.float32)
    sums = DepthShareSums()
    sums.add(CAMERA, true, shown, np.ones(true.shape, bool))
    found = sums.errors
    assert found is not None
    assert found.level_rmse_share == pytest.approx(0) and found.plane_rmse_share == pytest.approx(0, abs=1e-6)


def test_depth_baseline_shares_of_known_surface() -> None:
    true = SURFACES["bowl"].astype(np.float32)
    sums = DepthShareSums()
    sums.add(CAMERA, true, true, np.ones(true.shape, bool))
    found, z = sums.errors, true.ravel().astype(np.float64)
    assert found is not None
    least = least_error_by_search(RAYS.reshape(-1, 3), z)
    assert found.plane_rmse_share == pytest.approx(np.sqrt(least / z.size) / np.median(z), rel=1e-3)
    level = np.sqrt(np.mean((z - np.median(z)) ** 2)) / np.median(z)
    assert found.level_rmse_share == pytest.approx(level, rel=1e-6)


def test_normal_baselines_of_tilted_plane() -> None:
    true = SURFACES["tilted plane"].astype(np.float32)
    sums = NormalSums()
    sums.add(CAMERA, true, true, np.ones(true.shape, bool))
    found = sums.errors
    assert found is not None
    tilt = np.degrees(np.arctan(np.hypot(0.4, 0.3)))
    assert found.plane_mean_deg < 0.5 and found.level_mean_deg == pytest.approx(tilt, abs=0.5)
