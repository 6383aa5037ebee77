"""Shares of guesses, learned place by place."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.experimental.learned_prior import MOST_CELLS, LocalShares, SharesSettings, cells_for

SETTINGS = SharesSettings(at_first=(0.5, 0.0), decay=0.9, around_cells=1.0, pull=0.01, ridge=0.001)


def noise(seed: int, shape: tuple[int, int, int] = (48, 64, 3)) -> NDArray[np.float32]:
    return np.random.default_rng(seed).normal(0, 1, shape).astype(np.float32)


def taught(shares: LocalShares, share_of: NDArray[np.float32], frames: int = 10) -> LocalShares:
    """Teach `shares` that the next motion is a local share [h, w] of the first prediction."""
    weight = np.ones(share_of.shape, np.float32)
    for seed in range(frames):
        first, second = noise(2 * seed), noise(2 * seed + 1)
        shares.learn([first, second], share_of[..., None] * first, weight)
    return shares


def test_local_shares_start_with_initial_values() -> None:
    shares = LocalShares(SETTINGS)
    assert shares.whole().tolist() == [0.5, 0.0]
    assert np.all(shares.local((10, 20)) == np.float32([0.5, 0.0]))


def test_local_shares_vary_by_place() -> None:
    share_of = np.full((48, 64), 0.2, np.float32)
    share_of[:, 32:] = 0.9
    local = taught(LocalShares(SETTINGS), share_of).local((48, 64))
    assert local[:, 4:24, 0].mean() == pytest.approx(0.2, abs=0.03)
    assert local[:, 40:60, 0].mean() == pytest.approx(0.9, abs=0.03)
    assert np.abs(local[..., 1]).mean() < 0.05


def test_local_shares_whole_equals_weighted_least_squares_fit() -> None:
    """Compare with `lstsq` over all pixels: earlier pixels weigh less, and the pull to the first shares adds rows."""
    shares, rows, right = LocalShares(SETTINGS), [], []
    weight = np.random.default_rng(9).uniform(0, 1, (20, 30)).astype(np.float32)
    for seed, factor in enumerate((SETTINGS.decay, 1.0)):
        first, second, came = (noise(3 * seed + k, (20, 30, 2)) for k in range(3))
        shares.learn([first, second], came, weight)
        scale = np.sqrt(factor * weight[..., None] / came.size)
        rows.append(np.stack([(scale * first).ravel(), (scale * second).ravel()], axis=1))
        right.append((scale * came).ravel())
    rows.append(np.sqrt(SETTINGS.ridge) * np.eye(2))
    right.append(np.sqrt(SETTINGS.ridge) * np.asarray(SETTINGS.at_first))
    expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    np.testing.assert_allclose(shares.whole(), expected, atol=1e-5)


def test_local_shares_follow_changes() -> None:
    shares = taught(LocalShares(SETTINGS), np.full((48, 64), 0.9, np.float32))
    assert taught(shares, np.full((48, 64), 0.1, np.float32), 40).whole()[0] == pytest.approx(0.1, abs=0.03)


def test_local_shares_ignore_pixels_without_tissue() -> None:
    shares, weight = LocalShares(SETTINGS), np.zeros((48, 64), np.float32)
    shares.learn([noise(0), noise(1)], noise(2), weight)
    np.testing.assert_allclose(shares.whole(), SETTINGS.at_first, atol=1e-6)


def test_local_shares_restart_after_size_change() -> None:
    shares = taught(LocalShares(SETTINGS), np.full((48, 64), 0.9, np.float32))
    first = noise(0, (12, 100, 3))
    shares.learn([first, noise(1, (12, 100, 3))], 0.3 * first, np.ones((12, 100), np.float32))
    assert shares.whole()[0] == pytest.approx(0.3, abs=0.03)


@pytest.mark.parametrize(("shape", "cells"), [((512, 640), (40, 32)), ((1, 900), (40, 1)), ((5, 3), (3, 5))])
def test_local_shares_number_of_cells_is_limited(shape: tuple[int, int], cells: tuple[int, int]) -> None:
    assert cells_for(shape) == cells
    assert max(cells) <= MOST_CELLS
