"""Gaussians in the first rows of tensors of fixed size."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from gsplat_core import Camera, InvalidInput, render
from gsplat_core.scene.gaussians import GaussianRows, RowMoves

CAMERA = Camera.from_focal(40.0, 32, 24)


def addresses(rows):
    return [(tensor.data_ptr(), tuple(tensor.shape)) for tensor in rows.all.tensors().values()]


def assert_same(actual, expected):
    for name, tensor in actual.tensors().items():
        assert torch.equal(tensor, expected.tensors()[name]), name


def assert_spare_rows_show_nothing(rows):
    with torch.no_grad():
        assert torch.equal(render(rows.all, CAMERA).image, render(rows.used, CAMERA).image)
    assert rows.all.opacities[rows.used.count :].count_nonzero() == 0


@pytest.mark.parametrize("seed", range(8))
def test_gaussian_rows_random_changes_equal_select_and_append(make_gaussians, seed):
    chance = torch.Generator().manual_seed(seed)
    expected = make_gaussians(30, seed=seed)
    rows = GaussianRows(expected, 50)
    at = addresses(rows)
    for turn in range(12):
        if torch.rand((), generator=chance) < 0.5 and expected.count <= 40:
            added = make_gaussians(10, seed=100 + turn)
            rows.append(added)
            expected = expected.append(added)
        else:
            removed = torch.rand(expected.count, generator=chance) < torch.rand((), generator=chance)
            moves = RowMoves.without(removed)
            rows.close_gaps(moves)
            left = {tuple(row) for row in expected.select(~removed).means.tolist()}
            expected = expected.select(moves.order)
            assert {tuple(row) for row in expected.means.tolist()} == left
        assert_same(rows.used, expected)
        assert_spare_rows_show_nothing(rows)
    assert addresses(rows) == at


@pytest.mark.parametrize("removed", [[], [0], [4], [0, 1, 2, 3, 4], [0, 4], [1, 2, 3], [3, 4]])
def test_row_moves_close_gaps(removed):
    leaving = torch.zeros(5, dtype=torch.bool)
    leaving[removed] = True
    moves = RowMoves.without(leaving)
    tensor = torch.arange(5.0)
    moves.apply(tensor, -1.0)
    kept = sorted(set(range(5)) - set(removed))
    assert sorted(tensor[: moves.count].tolist()) == kept and (tensor[moves.count :] == -1).all()
    assert sorted(moves.order.tolist()) == kept
    assert len(moves.to) <= len(removed)


def test_gaussian_rows_replace_scene(make_gaussians):
    rows = GaussianRows(make_gaussians(20), 25)
    at = addresses(rows)
    other = make_gaussians(7, seed=9)
    rows.replace(other)
    assert_same(rows.used, other)
    assert_spare_rows_show_nothing(rows)
    assert addresses(rows) == at


def test_gaussian_rows_reject_overflow_without_change(make_gaussians):
    rows = GaussianRows(make_gaussians(20), 25)
    with pytest.raises(InvalidInput, match="26 Gaussians do not fit into 25 rows"):
        rows.append(make_gaussians(6))
    assert rows.used.count == 20
    with pytest.raises(InvalidInput, match="do not fit"):
        GaussianRows(make_gaussians(20), 19)


def test_gaussian_rows_right_eye_colours_follow_rows(make_gaussians):
    first = make_gaussians(6)
    rows = GaussianRows(dataclasses.replace(first, right_sh=torch.arange(6.0)[:, None, None].expand_as(first.sh)), 9)
    at = addresses(rows)
    rows.append(make_gaussians(2, seed=9))
    rows.close_gaps(RowMoves.without(torch.arange(8) == 1))
    assert rows.used.right_sh[:, 0, 0].tolist() == [0, 0, 2, 3, 4, 5, 0]
    assert addresses(rows) == at and len(at) == 6
