"""Blended flow on CUDA against the reference in float64, in the same bits twice, and in a CUDA graph."""

import math

import pytest
import torch

from gsplat_core import Camera, reference
from gsplat_core.ops.flow_blending import blend_flow, intrinsics_of
from tests.gsplat_core.ops.flow_scenes import AFTER, BEFORE, FlowScene, flow_scene


def evaluated(function, scene, dtype, device, before=BEFORE):
    given = scene.converted(dtype, device)
    offsets, ids = (each.to(device) for each in scene.lists(before))
    blended = function(*given, before, AFTER, offsets, ids)
    weights = torch.randn(blended.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    weights[..., 3] = 0
    (blended * weights.to(device, dtype)).sum().backward()
    return blended.detach().cpu(), given.planes.grad.cpu()


@pytest.mark.parametrize("size", [(70, 45), (1, 1), (33, 18), (200, 130)])
@pytest.mark.parametrize("count", [0, 1, 5, 1200])
def test_blend_flow_values_and_gradients_equal_reference(gpu, assert_near, count, size):
    camera = Camera.from_focal(60.0, *size)
    scene = flow_scene(count, camera)
    blended, gradient = evaluated(blend_flow, scene, torch.float32, gpu, camera)
    wanted, wanted_gradient = evaluated(reference.blend_flow, scene, torch.float64, "cpu", camera)
    for channel in range(4):
        assert_near(blended[..., channel], wanted[..., channel], of_largest=5e-5)
    assert_near(gradient, wanted_gradient, of_largest=5e-5)


def test_blend_flow_of_opaque_splats_and_points_behind_camera(gpu, assert_near):
    scene = flow_scene(400, median_px=8.0)
    scene.opacities[::2] = 1.0
    scene.planes[::3, 2] = -40.0
    blended, gradient = evaluated(blend_flow, scene, torch.float32, gpu)
    wanted, wanted_gradient = evaluated(reference.blend_flow, scene, torch.float64, "cpu")
    assert_near(blended, wanted, of_largest=5e-5)
    assert_near(gradient, wanted_gradient, of_largest=5e-5)


def test_blend_flow_skips_non_finite_splats(gpu):
    scene = flow_scene(120)
    bad = torch.zeros(120, dtype=torch.bool)
    for number, tensor in enumerate((scene.means2d, scene.conics, scene.rays, scene.planes)):
        tensor[10 * number, 1], tensor[10 * number + 1, 0] = math.nan, math.inf
        bad[10 * number : 10 * number + 2] = True
    good = FlowScene(*(tensor[~bad] for tensor in scene))
    blended, gradient = evaluated(blend_flow, scene, torch.float32, gpu)
    wanted, wanted_gradient = evaluated(blend_flow, good, torch.float32, gpu)
    assert torch.equal(blended, wanted) and torch.equal(gradient[~bad], wanted_gradient)
    assert not gradient[bad].any()


def test_blend_flow_is_deterministic(gpu):
    scene = flow_scene(2000, median_px=8.0)
    first, second = (evaluated(blend_flow, scene, torch.float32, gpu) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_blend_flow_ops_pass_opcheck(gpu):
    scene = flow_scene(30).converted(torch.float32, gpu)
    offsets, ids = scene.lists(BEFORE)
    rest = (offsets, ids, intrinsics_of(BEFORE, AFTER), BEFORE.width_px, BEFORE.height_px)
    torch.library.opcheck(torch.ops.gsplat_core.blend_flow.default, (*scene, *rest))
    v = torch.ones(BEFORE.height_px, BEFORE.width_px, 4, device=gpu)
    planes = scene.planes.detach()
    torch.library.opcheck(torch.ops.gsplat_core.blend_flow_backward.default, (*scene[:4], planes, *rest, v))


def test_blend_flow_captured_in_graph(gpu):
    scene = FlowScene(*(tensor.detach() for tensor in flow_scene(300).converted(torch.float32, gpu)))
    offsets, ids = scene.lists(BEFORE)
    arguments = (*scene, offsets, ids, intrinsics_of(BEFORE, AFTER), BEFORE.width_px, BEFORE.height_px)
    ops = torch.ops.gsplat_core
    both = lambda: (flow := ops.blend_flow(*arguments), ops.blend_flow_backward(*arguments, flow))
    wanted = [each.clone() for each in both()]
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        both()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = both()
    for _ in range(2):
        graph.replay()
    assert all(torch.equal(a, b) for a, b in zip(captured, wanted, strict=True))
