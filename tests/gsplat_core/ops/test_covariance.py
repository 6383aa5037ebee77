"""Covariance and precision: the compiled op against the reference in float64, the reference against first principles."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import InvalidInput, quat_scale_to_covar_preci, reference


def inputs(*shape):
    g = torch.Generator().manual_seed(1)
    return torch.randn(*shape, 4, generator=g) * 2, torch.rand(*shape, 3, generator=g) + 0.3


def evaluate(function, quats, scales, dtype, **options):
    quats, scales = quats.to(dtype).requires_grad_(), scales.to(dtype).requires_grad_()
    out = function(quats, scales, **options)
    g = torch.Generator().manual_seed(2)
    # The weights are not symmetric: a gradient may come for one of two equal elements only.
    sum(
        (t * torch.rand(t.shape, generator=g, dtype=torch.float64).to(dtype)).sum() for t in out if t is not None
    ).backward()
    return [*out, quats.grad, scales.grad]


@pytest.mark.parametrize("triu", [False, True])
@pytest.mark.parametrize("wanted", [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("shape", [(50,), (2, 3, 7), (1,), (0,)])
def test_covariance_matches_reference(assert_near, triu, wanted, shape):
    options = {"compute_covar": wanted[0], "compute_preci": wanted[1], "triu": triu}
    ours = evaluate(quat_scale_to_covar_preci, *inputs(*shape), torch.float32, **options)
    exact = evaluate(reference.quat_scale_to_covar_preci, *inputs(*shape), torch.float64, **options)
    for actual, expected in zip(ours, exact, strict=True):
        assert_near(actual, expected, of_largest=1e-5)


def test_covariance_eigenvalues_are_squared_scales_and_precision_is_inverse():
    quats, scales = (t.double() for t in inputs(20))
    covar, preci = reference.quat_scale_to_covar_preci(quats, scales)
    torch.testing.assert_close(torch.linalg.eigvalsh(covar), (scales**2).sort(-1).values)
    torch.testing.assert_close(covar @ preci, torch.eye(3).double().expand(20, 3, 3))


def test_covariance_of_quarter_turn_about_z_swaps_x_and_y():
    covar, _ = quat_scale_to_covar_preci(torch.tensor([1.0, 0, 0, 1]), torch.tensor([1.0, 2, 3]))
    torch.testing.assert_close(covar, torch.diag(torch.tensor([4.0, 1, 9])))
    # An eighth of a turn tells the direction: x stretched to 3 turns towards +y.
    eighth = torch.tensor([0.92387953, 0, 0, 0.38268343])
    covar, _ = quat_scale_to_covar_preci(eighth, torch.tensor([3.0, 1, 1]))
    torch.testing.assert_close(covar[:2, :2], torch.tensor([[5.0, 4], [4, 5]]))


def test_covariance_triu_equals_upper_triangle():
    quats, scales = inputs(4)
    full, _ = quat_scale_to_covar_preci(quats, scales)
    triu, _ = quat_scale_to_covar_preci(quats, scales, triu=True)
    rows, columns = torch.triu_indices(3, 3)
    torch.testing.assert_close(triu, full[:, rows, columns])


def test_covariance_reference_passes_gradcheck():
    quats, scales = (t.double().requires_grad_() for t in inputs(5))
    assert torch.autograd.gradcheck(reference.quat_scale_to_covar_preci, (quats, scales))


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.parametrize("triu", [False, True])
def test_covariance_ops_pass_opcheck(triu):
    quats, scales = inputs(5)
    leaves = quats.requires_grad_(), scales.requires_grad_()
    torch.library.opcheck(torch.ops.gsplat_core.quat_scale_to_covar_preci, (*leaves, True, True, triu))
    v = torch.ones(5, 6) if triu else torch.ones(5, 3, 3)
    arguments = (quats.detach(), scales.detach(), v, None, triu)
    torch.library.opcheck(torch.ops.gsplat_core.quat_scale_to_covar_preci_backward, arguments)


def test_covariance_rejects_invalid_arguments():
    quats, scales = inputs(5)
    for arguments, message in [
        ((quats[:, :3], scales), r"quats must be \[..., 4\] \(wxyz\), got \[5, 3\]"),
        ((quats, scales[:4]), r"scales .*\[5, 3\], got \[4, 3\]"),
        ((quats.double(), scales.double()), r"gsplat_core\.reference"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            quat_scale_to_covar_preci(*arguments)
