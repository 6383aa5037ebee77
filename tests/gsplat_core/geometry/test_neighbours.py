"""The nearest neighbours of points: against all distances, and where points are few, at one place or not finite."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.geometry.registration import NEIGHBOURS, nearest_others


def test_nearest_others_equals_brute_force():
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) + 1000.0
    found = nearest_others(points)
    apart = torch.cdist(points.double() - 1000, points.double() - 1000).fill_diagonal_(torch.inf)
    nearest = apart.topk(NEIGHBOURS, largest=False)
    torch.testing.assert_close(apart.gather(1, found).sort(1).values, nearest.values)
    assert torch.equal(found, nearest_others(points))


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_nearest_others_of_few_points(count):
    found = nearest_others(torch.randn(count, 3))
    assert found.dtype == torch.int64 and tuple(found.shape) == (count, min(NEIGHBOURS, max(count - 1, 0)))
    for row, others in enumerate(found.tolist()):
        assert sorted([row, *others]) == list(range(count))


def test_nearest_others_of_coincident_points_exclude_self():
    found = nearest_others(torch.ones(40, 3))
    assert not (found == torch.arange(40)[:, None]).any()
    assert all(len(set(others)) == NEIGHBOURS for others in found.tolist())


def test_nearest_others_isolate_non_finite_points():
    points = torch.randn(30, 3, generator=torch.Generator().manual_seed(2))
    points[3, 1], points[7, 0] = torch.nan, torch.inf
    found = nearest_others(points)
    assert set(found[3].tolist()) == {3} and set(found[7].tolist()) == {7}
    rest = torch.cat([found[:3], found[4:7], found[8:]])
    assert not ((rest == 3) | (rest == 7)).any()
