"""Depth at sparse points, of scenes whose depth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.sparse_points import SparseDepthSums, SparsePoints
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.cameras import Camera

CAMERA = Camera.from_focal(50.0, 60, 40)


def some_points() -> SparsePoints:
    random = np.random.default_rng(0)
    z = random.uniform(2, 4, 200)
    pixels = random.uniform([2, 2], [58, 38], (200, 2))
    points = np.concatenate([(pixels - CAMERA.K[:2, 2]) / 50 * z[:, None], z[:, None]], 1)
    return SparsePoints(points, np.arange(200), np.arange(200) % 2)


def drawn(points: SparsePoints, number: int) -> np.ndarray:
    depth = np.zeros((40, 60), np.float32)
    pixels, z = points.seen_in(number, CAMERA)
    depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] = z
    return depth


def test_sparse_depth_error_independent_of_unit() -> None:
    points = some_points()
    sums = SparseDepthSums(points)
    sums.add(0, 7 * drawn(points, 0), CAMERA)
    sums.add(1, 7 * drawn(points, 1), CAMERA)
    found = sums.errors()
    assert found is not None
    assert found.median == pytest.approx(0, abs=1e-6)
    assert found.scale == pytest.approx(1 / 7)
    assert found.rank_correlation > 0.95
    assert found.covered == 1
    assert found.sightings == 200


def test_sparse_depth_uses_one_factor_for_all_frames() -> None:
    points = some_points()
    sums = SparseDepthSums(points)
    sums.add(0, drawn(points, 0), CAMERA)
    sums.add(1, 2 * drawn(points, 1), CAMERA)
    found = sums.errors()
    assert found is not None
    assert found.median > 0.1


def test_sparse_depth_rank_correlation_of_plane_is_zero() -> None:
    points = some_points()
    sums = SparseDepthSums(points)
    for number in (0, 1):
        sums.add(number, np.full((40, 60), 9, np.float32), CAMERA)
    found = sums.errors()
    assert found is not None
    assert found.rank_correlation == 0
    assert found.median > 0.1
    assert found.median == pytest.approx(found.level_median, rel=0.05)


def test_sparse_depth_ignores_pixels_without_depth() -> None:
    points = some_points()
    sums = SparseDepthSums(points)
    assert sums.errors() is None
    sums.add(0, np.zeros((40, 60), np.float32), CAMERA)
    assert sums.errors() is None
    sums.add(1, drawn(points, 1), CAMERA)
    found = sums.errors()
    assert found is not None
    assert found.covered == pytest.approx(0.5)


def test_sparse_points_omit_points_behind_camera_or_outside_image() -> None:
    points = SparsePoints(np.array([[0, 0, -3.0], [9, 0, 3], [0, 0, 3]]), np.arange(3), np.zeros(3, np.int64))
    pixels, z = points.seen_in(0, CAMERA)
    assert pixels.tolist() == [[30, 20]]
    assert z.tolist() == [3]


def test_sparse_points_reject_inconsistent_files(tmp_path: Path) -> None:
    path = tmp_path / "points.npz"
    whole = {"points": np.zeros((3, 3)), "obs_point": np.zeros(4, int), "obs_frame": np.zeros(4, int)}
    np.savez(path, **whole)
    assert len(SparsePoints.read(path).seen_frame) == 4
    for change, said in (
        ({"points": np.zeros((3, 2))}, "P, 3"),
        ({"obs_point": np.full(4, 3)}, "from 3 to 3"),
        ({"obs_frame": np.zeros(5, int)}, "obs_frame"),
    ):
        np.savez(path, **{**whole, **change})
        with pytest.raises(InvalidInput, match=said):
            SparsePoints.read(path)
    np.savez(path, points=np.zeros((3, 3)))
    with pytest.raises(InvalidInput, match="obs_frame, obs_point"):
        SparsePoints.read(path)


def test_sparse_depth_rejects_depth_of_different_size() -> None:
    with pytest.raises(InvalidInput, match="60x40"):
        SparseDepthSums(some_points()).add(0, np.zeros((60, 40), np.float32), CAMERA)


def test_sparse_depth_plane_baselines_of_sloped_points() -> None:
    """Points on a tilted plane have no error to the best-fit plane and an error to the level plane."""
    pixels = np.mgrid[5:35:6, 5:55:8].reshape(2, -1).T[:, ::-1] + 0.5
    rays = np.column_stack([(pixels - CAMERA.K[:2, 2]) / np.diag(CAMERA.K)[:2], np.ones(len(pixels))])
    z = 3 / (1 - 0.5 * rays[:, 0])
    count = len(z)
    points = SparsePoints(rays * z[:, None], np.arange(count), np.zeros(count, np.int64))
    sums = SparseDepthSums(points)
    sums.add(0, np.full((CAMERA.height_px, CAMERA.width_px), 3, np.float32), CAMERA)
    found = sums.errors()
    assert found is not None and found.plane_median < 1e-6 < 0.05 < found.level_median
