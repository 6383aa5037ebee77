"""Statistics of gradients and noise on positions on CUDA against the reference in float64."""

import pytest
import torch

from gsplat_core import reference
from gsplat_core.ops.densification import accumulate_gradient_norms_, diffuse_positions_

NOISE = (0.7, 0.01, 100.0)


def screen(images, count):
    g = torch.Generator().manual_seed(0)
    radii = torch.randint(-1, 90, (images, count, 2), generator=g, dtype=torch.int32)
    return torch.randn(images, count, 2, generator=g), radii, torch.rand(3, count, generator=g)


def gaussians(count):
    g = torch.Generator().manual_seed(0)
    normal = lambda *shape: torch.randn(*shape, generator=g)
    given = [normal(count, 3), normal(count, 4) * 3, normal(count, 3) - 1, 4 * normal(count) - 4, normal(count, 3)]
    if count > 3:
        given[1][1], given[2][2, 0], given[4][3, 1] = 0, float("nan"), float("inf")
    return given


@pytest.mark.parametrize("with_radii", [True, False])
@pytest.mark.parametrize(("images", "count"), [(0, 3), (1, 0), (1, 1), (3, 100_003)])
def test_gradient_norms_equal_reference_and_are_deterministic(gpu, assert_near, images, count, with_radii):
    gradients, radii, start = screen(images, count)

    def run(function, convert):
        state = convert(start)
        largest = state[2] if with_radii else None
        function(convert(gradients), radii.to(state.device), (3.0, 0.5), 1 / 64, state[0], state[1], largest)
        return state.cpu()

    ours, again = (run(accumulate_gradient_norms_, lambda t: t.to(gpu, copy=True)) for _ in range(2))
    assert torch.equal(ours, again)
    assert_near(ours, run(reference.accumulate_gradient_norms_, lambda t: t.double()), of_largest=1e-6)


@pytest.mark.parametrize("count", [0, 1, 7, 100_003])
def test_diffuse_positions_equals_reference_and_is_deterministic(gpu, assert_near, count):
    given = gaussians(count)

    def run(function, convert):
        means, *rest = (convert(each) for each in given)
        function(means, *rest, *NOISE)
        return means.cpu()

    ours, again = (run(diffuse_positions_, lambda t: t.to(gpu, copy=True)) for _ in range(2))
    assert torch.equal(ours, again)
    exact = run(reference.diffuse_positions_, lambda t: t.double())
    assert_near(ours - given[0], exact - given[0].double(), of_largest=1e-5)


def test_densification_ops_captured_in_graph(gpu):
    gradients, radii, start = (each.to(gpu) for each in screen(2, 1000))
    means, *rest = (each.to(gpu) for each in gaussians(1000))
    state, moved = start.clone(), means.clone()

    def run():
        accumulate_gradient_norms_(gradients, radii, (1.0, 1.0), 1.0, *state)
        diffuse_positions_(moved, *rest, *NOISE)

    run()
    wanted = state.clone(), moved.clone()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    state.copy_(start)
    moved.copy_(means)
    graph.replay()
    assert torch.equal(state, wanted[0])
    assert torch.equal(moved, wanted[1])


def test_densification_ops_pass_opcheck(gpu):
    gradients, radii, state = (each.to(gpu) for each in screen(2, 9))
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.accumulate_gradient_norms_.default, (gradients, radii, 1.0, 2.0, 0.5, *state.clone()))
    torch.library.opcheck(ops.diffuse_positions_.default, (*(each.to(gpu) for each in gaussians(9)), *NOISE))
