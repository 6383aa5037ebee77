"""Blending of ray depths on CUDA, forward and backward, against plain torch in float64 and against the CPU."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core.ops.ray_blending import MAX_CHANNELS, blend_rays, splat_contributions
from tests.gsplat_core.ops.ray_scenes import INPUTS, assert_close, exact_contributions, ray_scene, with_bad_values


@pytest.mark.parametrize("channels", [0, 1, 3, 4, 8, 9, MAX_CHANNELS])
def test_blend_rays_with_any_number_of_channels(gpu, channels):
    assert_close(ray_scene(300, channels=channels), gpu)


@pytest.mark.parametrize("size", [(1, 1), (33, 50), (7, 100)])
@pytest.mark.parametrize("count", [0, 1, 90])
def test_blend_rays_of_any_image_size_and_few_splats(gpu, size, count):
    assert_close(ray_scene(count, *size), gpu)


def test_blend_rays_of_opaque_and_thin_splats(gpu):
    s = ray_scene(300)
    s.opacities[::2] = 1.0
    s.conics[1::5] = torch.tensor([1e-8, 0.0, 1e-8])
    s.conics[2::5] = torch.tensor([3.3, 0.0, 3.3])
    s.conics[3::25] = 0.0
    assert_close(s, gpu)


def test_blend_rays_skips_non_finite_splats_without_gradient(gpu):
    s, bad = with_bad_values(ray_scene(200))
    seen = assert_close(s, gpu)
    wanted = replace(s, **{name: getattr(s, name)[~bad] for name in INPUTS}).run(device=gpu)
    for name, value in wanted.items():
        if name.startswith("v_"):
            assert not seen[name][bad].any()
            assert torch.equal(seen[name][~bad], value)
        else:
            assert torch.equal(seen[name], value)


def test_blend_rays_of_large_scene_equals_cpu_and_is_deterministic(gpu):
    s = ray_scene(20_000, 640, 512)
    first, second, cpu = s.run(device=gpu), s.run(device=gpu), s.run()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
        error = (value - cpu[name]).norm()
        assert error <= 5e-3 * cpu[name].norm(), (name, float(error / cpu[name].norm()))


def test_blend_rays_skips_indices_out_of_range(gpu):
    s = ray_scene(20)
    offsets, ids = (tensor.to(gpu) for tensor in s.lists())
    inputs = [getattr(s, name).to(gpu).requires_grad_() for name in INPUTS]
    broken = ids.clone()
    broken[::3] = 2**30
    broken[1::3] = -5
    blended = blend_rays(*inputs, s.width, s.height, offsets, broken)
    (blended.depths.sum() + blended.values.sum()).backward()
    assert all(bool(tensor.grad.isfinite().all()) for tensor in inputs)


def test_blend_rays_captured_in_graph(gpu):
    s = ray_scene(300)
    lists = [tensor.to(gpu) for tensor in s.lists()]
    inputs = [getattr(s, name).to(gpu).requires_grad_() for name in INPUTS]

    def step():
        blended = blend_rays(*inputs, s.width, s.height, *lists)
        return *blended, *torch.autograd.grad(blended.depths.sum() + blended.values.sum(), inputs)

    # One stream for all steps, because autograd warns when the node of an input was created on another one.
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        wanted = [tensor.clone() for tensor in step()]
        step()
    side.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=side):
        results = step()
    graph.replay()
    torch.cuda.synchronize()
    assert all(torch.equal(a, b) for a, b in zip(results, wanted, strict=True))


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
def test_blend_rays_passes_opcheck(gpu):
    s = ray_scene(30, 20, 18)
    lists = [tensor.to(gpu) for tensor in s.lists()]
    splats = [getattr(s, name).to(gpu).requires_grad_() for name in INPUTS]
    torch.library.opcheck(torch.ops.gsplat_core.blend_rays.default, (*splats, *lists, s.width, s.height))


def test_splat_contributions_are_largest_weights(gpu):
    s = ray_scene(300)
    splats = [tensor.to(gpu) for tensor in (s.means2d, s.conics, s.opacities)]
    lists = [tensor.to(gpu) for tensor in s.lists()]
    seen, again = (splat_contributions(*splats, s.width, s.height, *lists) for _ in range(2))
    assert torch.equal(seen, again)
    torch.testing.assert_close(seen.cpu().double(), exact_contributions(s), rtol=1e-4, atol=1e-4)
