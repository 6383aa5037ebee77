"""Smoothing along time: towards the mean of the neighbours, both ends held, in place, for each kind of field."""

import math

import pytest
import torch

from gsplat_core.deformation import BasisField, HexPlaneField
from gsplat_core.deformation.basis_bumps import least_squares_weights
from gsplat_core.deformation.field import ROWS_AT_ONCE, towards_neighbours_, towards_others_
from gsplat_core.ops.plain_torch import basis_field


@pytest.mark.parametrize("amount", [0.0, 0.3, 1.0])
def test_towards_neighbours_moves_towards_mean_of_neighbours(amount):
    values = torch.randn(3, 6, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = values.clone()
    expected[:, 1:-1] += amount * ((values[:, :-2] + values[:, 2:]) / 2 - values[:, 1:-1])
    towards_neighbours_(values, amount)
    torch.testing.assert_close(values, expected)


def test_towards_neighbours_keeps_linear_and_short_sequences():
    even = torch.arange(5.0)[None, :, None] * torch.tensor([1.0, -2.0])
    towards_neighbours_(even, 0.5)
    assert torch.equal(even, torch.arange(5.0)[None, :, None] * torch.tensor([1.0, -2.0]))
    for length in (0, 1, 2):
        short = torch.ones(2, length, 3)
        towards_neighbours_(short, 0.5)
        assert torch.equal(short, torch.ones(2, length, 3))
    towards_neighbours_(torch.ones(0, 5, 3), 0.5)


def test_towards_neighbours_processes_many_rows_in_parts():
    values = torch.zeros(ROWS_AT_ONCE + 3, 3, 1)
    values[:, 1] = 1
    towards_neighbours_(values, 0.25)
    assert torch.equal(values[:, 1], torch.full_like(values[:, 1], 0.75))


def test_basis_field_smooth_in_time_changes_weights_only():
    field = BasisField(4, (0.0, 1.0), bumps=9)
    with torch.no_grad():
        field.weights[:, 4] = 1.0
    centers, widths, address = field.centers.clone(), field.log_widths.clone(), field.weights.data_ptr()
    field.smooth_in_time(0.4)
    torch.testing.assert_close(field.weights[0, :, 0], torch.tensor([0, 0, 0, 0.2, 0.6, 0.2, 0, 0, 0]))
    assert torch.equal(field.centers, centers)
    assert torch.equal(field.log_widths, widths)
    assert field.weights.data_ptr() == address  # captured graphs stay valid


def test_field_with_history_limit_has_no_smoothing_or_follow():
    field = BasisField(2, (0.0, 0.5), bumps=5)
    assert field.capabilities.smooth_in_time is not None and field.capabilities.follow is not None
    field.keep_last(1.0)
    assert field.capabilities.smooth_in_time is None and field.capabilities.follow is None


def test_hexplane_smooth_in_time_changes_time_planes_only(make_gaussians):
    field = HexPlaneField(
        make_gaussians(5), (0.0, 1.0), channels=4, resolution=(6, 5, 4, 7), levels=(1, 2), width=8, depth=1
    )
    with torch.no_grad():
        for planes in field.planes:
            for plane in planes.values():
                plane.normal_(generator=torch.Generator().manual_seed(1))
    before = {name: tensor.clone() for name, tensor in field.state_dict().items()}
    field.smooth_in_time(0.5)
    for name, tensor in field.state_dict().items():
        if name.endswith(("xt", "yt", "zt")):
            rows = before[name]
            torch.testing.assert_close(tensor[1:-1], rows[1:-1] / 2 + (rows[:-2] + rows[2:]) / 4)
            assert torch.equal(tensor[[0, -1]], rows[[0, -1]])
        else:
            assert torch.equal(tensor, before[name])


def test_least_squares_weights_reproduce_course():
    taus = [1 + 0.5 * k for k in range(17)]
    course = torch.tensor([math.sin(0.7 * tau) for tau in taus], dtype=torch.float64)
    weights = least_squares_weights(taus, 11) @ course
    row = torch.arange(11, dtype=torch.float64)[None], torch.zeros(1, 11, dtype=torch.float64)
    again = torch.stack([basis_field(*row, weights[None, :, None], tau)[0, 0] for tau in taus])
    torch.testing.assert_close(again, course, atol=0.03, rtol=0)


@pytest.mark.parametrize("taus", [[1.0], [1.0, 1.0], [8.0], []])
def test_least_squares_weights_of_few_times_are_finite(taus):
    weights = least_squares_weights(taus, 10)
    assert weights.shape == (10, len(taus)) and weights.isfinite().all()


def test_basis_field_follow_changes_selected_rows_only():
    field = BasisField(5, (0.0, 1.0), bumps=13)
    times = [k / 12 for k in range(13)]
    offsets = torch.randn(2, 1, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor(times)[None, :, None]
    field.follow(slice(1, 3), times, offsets)
    for k, time_s in enumerate(times):
        deltas = field.deltas(time_s)
        torch.testing.assert_close(deltas[1:3, :3], offsets[:, k], atol=0.03, rtol=0)
        assert not deltas[[0, 3, 4]].any() and not deltas[:, 3:].any()


@pytest.mark.parametrize("shape", [(1, 2, 3), (5, 1, 3), (6, 4, 3)])
def test_towards_others_uses_values_before_update(shape):
    """Smooth all rows at once and compare with whole matrices."""
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(shape, generator=generator)
    others = torch.randint(0, shape[0], (shape[0], 4), generator=generator)
    expected = values + 0.3 * (values[others].mean(dim=1) - values)
    towards_others_(values, others, 0.3)
    torch.testing.assert_close(values, expected)
    alone = values.clone()
    towards_others_(alone, others[:, :0], 0.3)
    assert torch.equal(alone, values)


def test_basis_field_share_motion_changes_motion_only():
    field = BasisField(3, (0.0, 1.0), bumps=5)
    with torch.no_grad():
        field.weights[1] = 1.0
    address = field.weights.data_ptr()
    field.share_motion(torch.tensor([[1, 2], [0, 2], [0, 1]]), 0.5)
    torch.testing.assert_close(field.weights[:, 2, 0], torch.tensor([0.25, 0.5, 0.25]))
    torch.testing.assert_close(field.weights[:, 2, 3:], torch.tensor([0.0, 1.0, 0.0])[:, None].expand(3, 10))
    assert field.weights.data_ptr() == address  # captured graphs stay valid
