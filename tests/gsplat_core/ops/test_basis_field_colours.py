"""Colours added to a basis field at one time: the C++ op against its definition in plain torch."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops import basis_field as compiled
from gsplat_core.ops.basis_field import basis_field, basis_field_add_colours_
from tests.gsplat_core.ops.test_basis_field import bumps, gradient_of


@pytest.mark.parametrize("n", [0, 1, 2500])
@pytest.mark.parametrize("b", [1, 4, 16, 33])
def test_add_colours_equals_reference_and_reaches_requested_change(n, b):
    centers, log_widths, weights = bumps(n, b)
    change = gradient_of(n)[:, :3]
    for tau in (-9.0, 0.0, b / 2, b + 30.0):
        seen, wanted = weights.clone(), weights.clone()
        basis_field_add_colours_(centers, log_widths, seen, tau, change)
        reference.basis_field_add_colours_(centers, log_widths, wanted, tau, change)
        torch.testing.assert_close(seen, wanted, rtol=1e-5, atol=1e-5)
        assert torch.equal(seen[..., :10], weights[..., :10])
        shown = basis_field(centers, log_widths, seen, tau) - basis_field(centers, log_widths, weights, tau)
        taken = (seen != weights).flatten(1).any(1)
        torch.testing.assert_close(shown[taken][:, 10:], change[taken], rtol=1e-4, atol=1e-4)
        if n == 2500 and b > 1:
            assert float(taken.float().mean()) > 0.99 if tau == b / 2 else not (tau > b and taken.any())


@pytest.mark.parametrize("module", [compiled, reference])
def test_add_colours_skips_gaussians_with_invalid_change_only(module):
    centers, log_widths, weights = bumps(5, 8)
    centers[1, 3] = float("nan")
    centers[4] += 5.0  # nearly over
    change = torch.ones(5, 3)
    change[2, 1] = float("nan")
    change[3, 2] = float("inf")
    after = weights.clone()
    module.basis_field_add_colours_(centers, log_widths, after, 0.5, change)
    assert torch.equal(after[1:], weights[1:])
    assert not torch.equal(after[0], weights[0])


@pytest.mark.parametrize("change", [torch.ones(4, 3), torch.ones(5, 4), torch.ones(5, 3, dtype=torch.float64)])
def test_add_colours_rejects_other_shape_or_dtype(change):
    with pytest.raises(InvalidInput):
        basis_field_add_colours_(*bumps(5, 8), 0.5, change)


def test_add_colours_op_passes_opcheck():
    op = torch.ops.gsplat_core.basis_field_add_colours_.default
    torch.library.opcheck(op, (*bumps(5, 7), torch.tensor([3.0]), torch.ones(5, 3)))
