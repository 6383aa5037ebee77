"""Spherical harmonics on CUDA against the reference in float64."""

import pytest
import torch

from gsplat_core import reference, spherical_harmonics

pytestmark = pytest.mark.cuda


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize(("cameras", "count"), [(1, 0), (1, 1), (3, 1003)])
@pytest.mark.parametrize("masked", [False, True])
def test_values_and_gradients_equal_the_reference(gpu, assert_near, degree, cameras, count, masked):
    generator = torch.Generator().manual_seed(degree)
    dirs = torch.randn(cameras, count, 3, generator=generator)
    coeffs = torch.randn(count, 25, 3, generator=generator)
    weights = torch.rand(cameras, count, 3, generator=generator)
    masks = torch.rand(cameras, count, generator=generator) < 0.7 if masked else None
    if masks is not None:
        dirs[~masks] = torch.nan  # behind a mask nothing is looked at

    def run(function, convert):
        leaves = [convert(t).requires_grad_() for t in (dirs, coeffs)]
        out = function(degree, *leaves, None if masks is None else masks.to(leaves[0].device))
        (convert(weights) * out).sum().backward()
        return [out, *(leaf.grad for leaf in leaves)]

    ours = run(spherical_harmonics, lambda t: t.to(gpu, copy=True))
    exact = run(reference.spherical_harmonics, lambda t: t.double())
    for actual, wanted in zip(ours, exact, strict=True):
        assert_near(actual.cpu(), torch.zeros_like(actual.cpu()).double() if wanted is None else wanted)


def test_coefficients_that_are_not_contiguous(gpu):
    generator = torch.Generator().manual_seed(0)
    coeffs = torch.randn(3, 16, 100, generator=generator).to(gpu).permute(2, 1, 0)
    dirs = torch.randn(3, 100, generator=generator).to(gpu).T
    expected = spherical_harmonics(3, dirs.contiguous(), coeffs.contiguous())
    assert torch.equal(spherical_harmonics(3, dirs, coeffs), expected)
