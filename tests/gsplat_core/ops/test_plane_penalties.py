"""Penalties on planes too small to differ."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.reference import training


@pytest.mark.parametrize(("size", "wanted"), [((1, 1), 0.0), ((1, 3), 4.0), ((3, 1), 4.0), ((3, 3), 8.0)])
def test_total_variation_counts_axes_with_neighbours(size, wanted):
    rows, columns = (2.0 * torch.arange(n) for n in size)  # neighbours differ by 2 along both axes
    plane = (rows[:, None] + columns)[..., None].expand(*size, 4).clone().requires_grad_()
    value = training.total_variation(plane)
    value.backward()
    assert value.item() == wanted
    assert plane.grad.isfinite().all() and bool(plane.grad.any()) == bool(wanted)


@pytest.mark.parametrize("rows", [1, 2])
def test_second_difference_of_few_rows_is_zero(rows):
    plane = torch.rand(rows, 3, 4, requires_grad=True)
    value = training.second_difference_in_time(plane)
    value.backward()
    assert value.item() == 0 and not plane.grad.any()
