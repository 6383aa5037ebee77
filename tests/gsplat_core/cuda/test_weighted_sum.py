"""Weighted sums on CUDA against the reference in float64."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.ops.weighted_sum import weighted_sums

WIDTH, HEIGHT = 70, 45


def splats(count, channels=4, seed=1):
    g = torch.Generator().manual_seed(seed)
    means2d = torch.rand(count, 2, generator=g) * torch.tensor([WIDTH + 8.0, HEIGHT + 8.0]) - 4
    root = torch.randn(count, 2, 2, generator=g) * 2
    inverse = torch.linalg.inv(root @ root.transpose(1, 2) + 0.3 * torch.eye(2))
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    opacities = torch.rand(count, generator=g) * 3 - 0.7
    return means2d, conics, torch.randn(count, channels, generator=g), opacities, torch.randn(count, generator=g)


def lists_of(means2d, conics, opacities):
    spread = conics[:, 0] * conics[:, 2] - conics[:, 1].square()
    radii = (3.34 * torch.stack([conics[:, 2] / spread, conics[:, 0] / spread], 1).sqrt()).ceil().int()
    grid = TileGrid(16, -(-WIDTH // 16), -(-HEIGHT // 16))
    depths = torch.ones(1, len(means2d), device=means2d.device)
    _, ids, offsets = bin_splats(
        means2d[None], radii[None], depths, grid, conics=conics[None], opacities=opacities.abs().clamp(max=1)[None]
    )
    return offsets[0], ids


def evaluate(function, inputs):
    leaves = [t.clone().requires_grad_() for t in inputs]
    sums = function(leaves)
    weights = torch.randn(sums.shape, generator=torch.Generator().manual_seed(2))
    (sums * weights.to(sums)).sum().backward()
    return [sums.detach(), *(leaf.grad for leaf in leaves)]


def on_device(leaves):
    lists = lists_of(*(leaves[k].detach() for k in (0, 1, 3)))
    return weighted_sums(*leaves, WIDTH, HEIGHT, *lists)


@pytest.mark.parametrize("channels", [1, 3, 4, 6, 9])
@pytest.mark.parametrize("count", [0, 1, 700])
def test_values_and_gradients_equal_the_reference(gpu, assert_near, count, channels):
    inputs = splats(count, channels)
    ours = evaluate(on_device, [t.to(gpu) for t in inputs])
    exact = evaluate(lambda leaves: reference.weighted_sums(*leaves, WIDTH, HEIGHT), [t.double() for t in inputs])
    for actual, wanted in zip(ours, exact, strict=True):
        assert_near(actual.cpu(), wanted, of_largest=2e-5)


def test_the_same_bits_twice_and_in_any_order(gpu):
    inputs = [t.to(gpu) for t in splats(3000)]
    first, again = evaluate(on_device, inputs), evaluate(on_device, inputs)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    order = torch.randperm(3000, generator=torch.Generator().manual_seed(3)).to(gpu)
    turned = evaluate(on_device, [t[order] for t in inputs])
    assert torch.equal(turned[0], first[0])
    assert all(torch.equal(a, b[order]) for a, b in zip(turned[1:], first[1:], strict=True))


def test_a_splat_larger_than_the_picture(gpu, assert_near):
    inputs = list(splats(40))
    inputs[1][::4] *= 1e-4
    ours = evaluate(on_device, [t.to(gpu) for t in inputs])
    exact = evaluate(lambda leaves: reference.weighted_sums(*leaves, WIDTH, HEIGHT), [t.double() for t in inputs])
    for actual, wanted in zip(ours, exact, strict=True):
        assert_near(actual.cpu(), wanted, of_largest=5e-5)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 3e38])
@pytest.mark.parametrize("at", range(5))
def test_a_splat_with_a_hostile_value_affects_no_other(gpu, at, value):
    inputs = [t.to(gpu) for t in splats(60)]
    lists = lists_of(inputs[0], inputs[1], inputs[3])
    inputs[at][0] = value
    leaves = [t.requires_grad_() for t in inputs]
    sums = weighted_sums(*leaves, WIDTH, HEIGHT, *lists)
    sums.sum().backward()
    assert sums.isfinite().all()
    assert all(leaf.grad.isfinite().all() for leaf in leaves)


def test_lists_that_do_not_fit_are_skipped(gpu):
    inputs = [t.to(gpu) for t in splats(5)]
    offsets, ids = lists_of(inputs[0], inputs[1], inputs[3])
    wrong = torch.full_like(ids, 7)
    assert not weighted_sums(*inputs, WIDTH, HEIGHT, offsets, wrong).any()
    assert weighted_sums(*inputs, WIDTH, HEIGHT, offsets - 1000, ids).isfinite().all()


def test_captured_in_a_cuda_graph(gpu):
    inputs = [t.to(gpu) for t in splats(300)]
    lists = lists_of(inputs[0], inputs[1], inputs[3])
    v_sums = torch.rand(5, HEIGHT, WIDTH, device=gpu)
    ops = torch.ops.gsplat_core

    def run():
        return (
            ops.weighted_sums(*inputs, *lists, WIDTH, HEIGHT),
            *ops.weighted_sums_backward(*inputs, *lists, WIDTH, HEIGHT, v_sums),
        )

    wanted = run()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        seen = run()
    graph.replay()
    torch.cuda.synchronize()
    assert all(torch.equal(a, b) for a, b in zip(seen, wanted, strict=True))


def test_opcheck(gpu):
    inputs = [t.to(gpu) for t in splats(20)]
    lists = lists_of(inputs[0], inputs[1], inputs[3])
    torch.library.opcheck(
        torch.ops.gsplat_core.weighted_sums.default, (*(t.requires_grad_() for t in inputs), *lists, WIDTH, HEIGHT)
    )
