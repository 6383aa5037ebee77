"""Splat regression on CUDA against the reference in float64."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import reference
from gsplat_core.ops.splat_regression import splat_regression


def scene(points, splats, dims, channels, seed=1):
    g = torch.Generator().manual_seed(seed)
    x, b = torch.rand(points, dims, generator=g), torch.rand(splats, dims, generator=g)
    factors = 0.3 * torch.eye(dims) + 0.1 * torch.randn(splats, dims, dims, generator=g)
    return [x, b, factors, torch.randn(splats, channels, generator=g)]


def evaluate(function, points, *splats):
    splats = [t.detach().requires_grad_() for t in splats]
    out = function(points, *splats)
    weights = torch.rand(out.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(out)
    return [out, *torch.autograd.grad((out * weights).sum(), splats)]


@pytest.mark.parametrize("dims", [1, 2, 3, 4])
@pytest.mark.parametrize("channels", [1, 3, 6])
@pytest.mark.parametrize(("points", "splats"), [(1, 1), (300, 70), (20_001, 5)])
def test_splat_regression_values_and_gradients_equal_reference(gpu, assert_near, dims, channels, points, splats):
    tensors = scene(points, splats, dims, channels)
    ours = evaluate(splat_regression, *(t.to(gpu) for t in tensors))
    exact = evaluate(reference.splat_regression, *(t.double() for t in tensors))
    for actual, expected in zip(ours, exact, strict=True):
        assert_near(actual.cpu(), expected, of_largest=5e-5)


@pytest.mark.parametrize(("points", "splats", "channels"), [(0, 3, 2), (5, 0, 2), (5, 3, 0)])
def test_splat_regression_with_empty_inputs(gpu, points, splats, channels):
    out = evaluate(splat_regression, *(t.to(gpu) for t in scene(points, splats, 2, channels)))
    assert [tuple(t.shape) for t in out] == [(points, channels), (splats, 2), (splats, 2, 2), (splats, channels)]
    assert all(not t.any() for t in out)


def test_splat_regression_ignores_unusable_splats(gpu):
    points, centres, factors, values = (t.to(gpu) for t in scene(60, 7, 2, 3))
    wanted = evaluate(splat_regression, points, centres[3:], factors[3:], values[3:])
    factors[0] = torch.tensor([[1.0, 2], [2, 4]], device=gpu)
    centres[1, 0] = torch.inf
    values[2, 1] = torch.nan
    found = evaluate(splat_regression, points, centres, factors, values)
    assert torch.equal(found[0], wanted[0])
    for actual, expected in zip(found[1:], wanted[1:], strict=True):
        assert not actual[:3].any()
        assert torch.equal(actual[3:], expected)


def test_splat_regression_deterministic_and_captured_in_graph(gpu):
    tensors = [t.to(gpu) for t in scene(30_000, 65, 3, 5)]
    gradient = torch.rand(30_000, 5, device=gpu)
    ops = torch.ops.gsplat_core

    def run():
        return ops.splat_regression(*tensors), *ops.splat_regression_backward(*tensors, gradient)

    wanted = run()
    assert all(torch.equal(a, b) for a, b in zip(run(), wanted, strict=True))
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = run()
    for mine, new in zip(tensors, scene(30_000, 65, 3, 5, seed=4), strict=True):
        mine.copy_(new)
    graph.replay()
    assert all(torch.equal(a, b) for a, b in zip(captured, run(), strict=True))


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_splat_regression_ops_pass_opcheck(gpu):
    points, *splats = (t.to(gpu) for t in scene(60, 7, 2, 3))
    leaves = [t.requires_grad_() for t in splats]
    torch.library.opcheck(torch.ops.gsplat_core.splat_regression, (points, *leaves))
    plain = [t.detach() for t in leaves]
    gradient = torch.ones(60, 3, device=gpu)
    torch.library.opcheck(torch.ops.gsplat_core.splat_regression_backward, (points, *plain, gradient))
