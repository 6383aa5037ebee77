"""Covariances on CUDA against the reference in float64."""

import pytest
import torch

from gsplat_core import InvalidInput, quat_scale_to_covar_preci, reference


@pytest.mark.parametrize("triu", [True, False])
@pytest.mark.parametrize("count", [0, 1, 1003])
def test_covariance_values_and_gradients_equal_reference(gpu, assert_near, count, triu):
    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(count, 4, generator=generator)
    scales = (torch.randn(count, 3, generator=generator) * 0.5).exp()
    weights = [torch.rand(count, *((6,) if triu else (3, 3)), generator=generator) for _ in range(2)]

    def run(function, convert):
        leaves = [convert(t).requires_grad_() for t in (quats, scales)]
        out = function(*leaves, triu=triu)
        sum((convert(w) * o).sum() for w, o in zip(weights, out, strict=True)).backward()
        return [*out, *(leaf.grad for leaf in leaves)]

    ours = run(quat_scale_to_covar_preci, lambda t: t.to(gpu, copy=True))
    exact = run(reference.quat_scale_to_covar_preci, lambda t: t.double())
    for actual, wanted in zip(ours, exact, strict=True):
        assert_near(actual.cpu(), wanted)


@pytest.mark.parametrize("triu", [True, False])
def test_covariance_ops_pass_opcheck(gpu, triu):
    quats, scales = (torch.rand(9, n, device=gpu, requires_grad=True) for n in (4, 3))
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.quat_scale_to_covar_preci.default, (quats, scales, True, True, triu))
    plain = [t.detach() for t in (quats, scales)]
    matrices = ops.quat_scale_to_covar_preci(*plain, True, True, triu)
    for given in (matrices, (matrices[0], None), (None, matrices[1])):
        torch.library.opcheck(ops.quat_scale_to_covar_preci_backward.default, (*plain, *given, triu))


def test_covariance_independent_of_memory_layout(gpu):
    quats, scales = (torch.rand(1000, n, device=gpu) for n in (4, 3))
    wanted = quat_scale_to_covar_preci(quats, scales)
    shifted = [torch.empty(t.numel() + 1, device=gpu)[1:].view(t.shape).copy_(t) for t in (quats, scales)]
    turned = [t.T.contiguous().T for t in (quats, scales)]
    for seen in (quat_scale_to_covar_preci(*shifted), quat_scale_to_covar_preci(*turned)):
        assert all(torch.equal(a, b) for a, b in zip(seen, wanted, strict=True))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_covariance_rejects_other_dtypes(gpu, dtype):
    with pytest.raises(InvalidInput, match="must be float32"):
        quat_scale_to_covar_preci(*(torch.rand(5, n, device=gpu, dtype=dtype) for n in (4, 3)))
