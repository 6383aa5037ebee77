"""Covariances on CUDA against the reference in float64."""

import pytest
import torch

from gsplat_core import quat_scale_to_covar_preci, reference

pytestmark = pytest.mark.cuda


@pytest.mark.parametrize("triu", [True, False])
@pytest.mark.parametrize("count", [0, 1, 1003])
def test_values_and_gradients_equal_the_reference(gpu, assert_near, count, triu):
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
