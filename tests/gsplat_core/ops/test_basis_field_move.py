"""Moving the basis field at one time: the C++ op against its definition in plain torch."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.basis_field import basis_field, basis_field_move_to_
from tests.gsplat_core.ops.test_basis_field import bumps, gradient_of


@pytest.mark.parametrize("n", [0, 1, 2500])
@pytest.mark.parametrize("b", [1, 4, 16, 26, 33])
def test_move_to_equals_reference_and_reaches_target(n, b):
    for tau in (-3.0, 0.0, b / 2, b + 30.0):
        field, exact = bumps(n, b), bumps(n, b, torch.float64)
        target = gradient_of(n, seed=2)
        basis_field_move_to_(*field, tau, target)
        reference.basis_field_move_to_(*exact, tau, target.double())
        torch.testing.assert_close(field[2].double(), exact[2], rtol=1e-4, atol=1e-4)
        changed = (field[2] != bumps(n, b)[2]).any(dim=(1, 2))
        torch.testing.assert_close(basis_field(*field, tau)[changed], target[changed], rtol=1e-4, atol=1e-4)
        if n == 2500:
            share = float(changed.float().mean())
            assert share == 0 if tau == b + 30.0 else share > (0.99 if tau == b / 2 and b > 1 else 0)


def test_move_to_leaves_invalid_gaussians_unchanged():
    field = bumps(5, 8)
    target = gradient_of(5)
    target[0, 7] = float("nan")
    target[1, 0] = float("inf")
    field[0][2] = float("nan")
    field[0][3] = 1e9  # no bump reaches the time
    field[2][4, 3] = float("nan")
    before = field[2].clone()
    basis_field_move_to_(*field, 3.0, target)
    assert torch.equal(field[2].nan_to_num(), before.nan_to_num())


def test_move_to_rejects_other_shapes_and_passes_opcheck():
    field, target = bumps(5, 7), gradient_of(5)
    with pytest.raises(InvalidInput, match="target"):
        basis_field_move_to_(*field, 3.0, target[:, :12])
    op = torch.ops.gsplat_core.basis_field_move_to_.default
    torch.library.opcheck(op, (*field, torch.tensor([3.0]), target))
