"""Splat regression: the compiled op against the reference in float64, closed forms against autograd."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import InvalidInput, reference
from gsplat_core.ops.splat_regression import splat_regression


def scene(points=60, splats=7, dims=2, channels=3, dtype=torch.float32):
    g = torch.Generator().manual_seed(1)
    x, b = torch.rand(points, dims, generator=g), torch.rand(splats, dims, generator=g)
    factors = 0.3 * torch.eye(dims) + 0.1 * torch.randn(splats, dims, dims, generator=g)
    return [t.to(dtype) for t in (x, b, factors, torch.randn(splats, channels, generator=g))]


def evaluate(function, points, *splats):
    splats = [t.requires_grad_() for t in splats]
    out = function(points, *splats)
    weights = torch.rand(out.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(out.dtype)
    return [out, *torch.autograd.grad((out * weights).sum(), splats, allow_unused=True)]


@pytest.mark.parametrize("dims", [1, 2, 3, 4])
@pytest.mark.parametrize("channels", [1, 3, 6])
@pytest.mark.parametrize("points", [1, 17, 2500])
def test_splat_regression_values_and_gradients_equal_reference(assert_near, dims, channels, points):
    ours = evaluate(splat_regression, *scene(points, 7, dims, channels))
    exact = evaluate(reference.splat_regression, *(t.double() for t in scene(points, 7, dims, channels)))
    for actual, expected in zip(ours, exact, strict=True):
        assert_near(actual, expected, of_largest=5e-5)


@pytest.mark.parametrize("dims", [1, 2, 3, 4])
def test_splat_regression_closed_form_gradients_equal_autograd(dims):
    points, *splats = scene(40, 5, dims, 2, torch.float64)
    splats = [t.requires_grad_() for t in splats]
    target = torch.randn(40, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found = reference.splat_regression(points, *splats)
    wanted = torch.autograd.grad((target - found).square().sum() / 40, splats)
    gradient = -2 / 40 * (target - found)
    for actual, expected in zip(reference.splat_regression_gradients(points, *splats, gradient), wanted, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-10, atol=1e-10)


def test_splat_regression_integral_of_splat_equals_value():
    x = torch.linspace(-4, 5, 4001, dtype=torch.float32)[:, None]
    found = splat_regression(x, torch.tensor([[0.5]]), torch.tensor([[[-0.3]]]), torch.tensor([[2.0, -1.0]]))
    torch.testing.assert_close(found.sum(0) * 9 / 4000, torch.tensor([2.0, -1.0]), rtol=1e-4, atol=0)


@pytest.mark.parametrize(("points", "splats", "channels"), [(0, 3, 2), (5, 0, 2), (5, 3, 0)])
def test_splat_regression_with_empty_inputs(points, splats, channels):
    out = evaluate(splat_regression, *scene(points, splats, 2, channels))
    assert [tuple(t.shape) for t in out] == [(points, channels), (splats, 2), (splats, 2, 2), (splats, channels)]
    assert all(not t.any() for t in out)


def test_splat_regression_ignores_unusable_splats_and_points():
    points, centres, factors, values = scene()
    wanted = evaluate(splat_regression, points, centres[3:], factors[3:], values[3:])
    factors[0] = torch.tensor([[1.0, 2], [2, 4]])
    centres[1, 0] = torch.inf
    values[2, 1] = torch.nan
    found = evaluate(splat_regression, points, centres, factors, values)
    torch.testing.assert_close(found[0], wanted[0], rtol=0, atol=0)
    for actual, expected in zip(found[1:], wanted[1:], strict=True):
        assert not actual[:3].any()
        torch.testing.assert_close(actual[3:], expected, rtol=0, atol=0)
    points[4] = torch.nan
    found = evaluate(splat_regression, points, *(t[3:].detach() for t in (centres, factors, values)))
    assert not found[0][4].any()
    assert all(t.isfinite().all() for t in found)


def test_splat_regression_independent_of_thread_count():
    found = []
    for threads in (1, 2, 3):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            found.append(evaluate(splat_regression, *scene(5000, 30, 3, 5)))
        finally:
            torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_splat_regression_reference_passes_gradcheck():
    points, *splats = scene(6, 3, 2, 2, torch.float64)
    leaves = [t.requires_grad_() for t in splats]
    assert torch.autograd.gradcheck(lambda *s: reference.splat_regression(points, *s), leaves)


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_splat_regression_ops_pass_opcheck():
    points, *splats = scene()
    leaves = [t.requires_grad_() for t in splats]
    torch.library.opcheck(torch.ops.gsplat_core.splat_regression, (points, *leaves))
    plain = [t.detach() for t in leaves]
    torch.library.opcheck(torch.ops.gsplat_core.splat_regression_backward, (points, *plain, torch.ones(60, 3)))


def test_splat_regression_rejects_invalid_arguments():
    points, centres, factors, values = scene()
    for arguments, message in [
        ((torch.rand(5, 5), centres, factors, values), r"points must be \[n, d\] with d = 1 to 4, got \[5, 5\]"),
        ((points, centres[:, :1], factors, values), r"centres must be \[7, 2\] for 7 splats, got \[7, 1\]"),
        ((points, centres, factors[:3], values), r"factors must be \[7, 2, 2\] for 7 splats, got \[3, 2, 2\]"),
        ((points, centres, factors, values[0]), r"values must be \[7, m\] for 7 splats, got \[3\]"),
        ((points.double(), centres, factors, values), "float32"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            splat_regression(*arguments)
