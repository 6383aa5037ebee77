"""Depth histograms on CUDA, forward and backward, against plain torch in float64 and against the CPU."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops.range_histogram import Bins
from tests.gsplat_core.ops.range_scenes import BINS, TENSORS, assert_close, pixel_factors, run
from tests.gsplat_core.ops.ray_scenes import ray_scene


@pytest.mark.parametrize("factors", [False, True])
@pytest.mark.parametrize("bins", [BINS, Bins(30.0, 0.05, 300), Bins(0.0, 200.0, 1)])
def test_range_histogram_of_random_scene(gpu, bins, factors):
    s = ray_scene(300)
    assert_close(s, gpu, bins, pixel_factors(s.width, s.height) if factors else None)


@pytest.mark.parametrize("size", [(1, 1), (33, 50), (7, 100)])
@pytest.mark.parametrize("count", [0, 1, 90])
def test_range_histogram_of_any_image_size_and_few_splats(gpu, size, count):
    assert_close(ray_scene(count, *size), gpu)


def test_range_histogram_of_large_scene_equals_cpu_and_is_deterministic(gpu):
    s = ray_scene(20_000, 320, 256)
    first, second, cpu = run(s, device=gpu), run(s, device=gpu), run(s)
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
        error = (value - cpu[name]).norm()
        assert error <= 5e-3 * cpu[name].norm(), (name, float(error / cpu[name].norm()))


def test_range_histogram_in_graph_reads_new_splats(gpu):
    ops = torch.ops.gsplat_core
    s = ray_scene(200, 64, 48)
    inputs = [getattr(s, name).to(gpu) for name in TENSORS]
    lists = [tensor.to(gpu) for tensor in s.lists()]
    rest, gradient = (*BINS, 64, 48, 0.99), torch.rand(64, BINS.number, device=gpu)

    def both():
        return (
            ops.range_histogram(*inputs, *lists, None, *rest),
            *ops.range_histogram_backward(*inputs, *lists, None, gradient, *rest),
        )

    both()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = both()
    inputs[3][:, 0] += 2.0
    inputs[2].mul_(0.7)
    graph.replay()
    assert all(torch.equal(a, b) for a, b in zip(captured, both(), strict=True))


def test_range_histogram_skips_indices_out_of_range(gpu):
    s = ray_scene(20, 40, 30)
    inputs = [getattr(s, name).to(gpu) for name in TENSORS]
    offsets, ids = (tensor.to(gpu) for tensor in s.lists())
    ids[::7] = 10**6
    ids[1::7] = -1
    rest = (*BINS, 40, 30, 0.99)
    out = torch.ops.gsplat_core.range_histogram(*inputs, offsets, ids, None, *rest)
    gradients = torch.ops.gsplat_core.range_histogram_backward(
        *inputs, offsets, ids, None, torch.ones(40, BINS.number, device=gpu), *rest
    )
    assert all(t.isfinite().all() for t in (out, *gradients))


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_range_histogram_ops_pass_opcheck(gpu):
    s = ray_scene(20, 40, 30)
    inputs = [getattr(s, name).to(gpu).requires_grad_() for name in TENSORS]
    lists = [tensor.to(gpu) for tensor in s.lists()]
    rest = (*BINS, 40, 30, 0.99)
    torch.library.opcheck(torch.ops.gsplat_core.range_histogram, (*inputs, *lists, None, *rest))
    plain = [t.detach() for t in inputs]
    gradient = torch.ones(40, BINS.number, device=gpu)
    torch.library.opcheck(torch.ops.gsplat_core.range_histogram_backward, (*plain, *lists, None, gradient, *rest))
