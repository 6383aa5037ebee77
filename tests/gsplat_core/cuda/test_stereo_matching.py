"""Semi-global matching on the GPU: bit-identical to the CPU, on any stream and in a CUDA graph."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops.stereo_matching import match_disparities
from tests.gsplat_core.ops.stereo_cases import every_case, pair


def check_against_cpu(gpu, left, right, lowest, count):
    found = match_disparities(left.to(gpu), right.to(gpu), lowest, count)
    expected = match_disparities(left, right, lowest, count)
    assert torch.equal(found.sixteenths.cpu(), expected.sixteenths)
    assert torch.equal(found.one_surface.cpu(), expected.one_surface)


@every_case
def test_stereo_matching_equals_cpu(gpu, case):
    kind, height, width, lowest, count = case
    check_against_cpu(gpu, *pair(kind, height, width), lowest, count)


@pytest.mark.parametrize(("height", "width", "count"), [(512, 640, 64), (511, 641, 128), (300, 800, 256)])
@pytest.mark.parametrize("kind", ["texture", "noise", "steps"])
def test_stereo_matching_of_usual_image_sizes_equals_cpu(gpu, kind, height, width, count):
    check_against_cpu(gpu, *pair(kind, height, width), -5, count)


def test_stereo_matching_is_deterministic(gpu):
    left, right = (each.to(gpu) for each in pair("noise", 300, 400))
    first, second = (match_disparities(left, right, -8, 32).sixteenths for _ in range(2))
    assert torch.equal(first, second)


def test_stereo_matching_without_pixels(gpu):
    nothing = torch.zeros(0, 7, dtype=torch.uint8, device=gpu)
    assert match_disparities(nothing, nothing, 0, 16).sixteenths.shape == (0, 7)


def test_stereo_matching_on_side_stream_and_in_graph(gpu):
    left, right = (each.to(gpu) for each in pair("steps", 120, 160))
    expected = match_disparities(left, right, 0, 32)
    torch.cuda.synchronize()
    stream = torch.cuda.Stream(gpu)
    with torch.cuda.stream(stream):
        beside = match_disparities(left, right, 0, 32)
    stream.synchronize()
    assert torch.equal(beside.sixteenths, expected.sixteenths)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = match_disparities(left, right, 0, 32)
    captured.sixteenths.zero_()
    graph.replay()
    assert torch.equal(captured.sixteenths, expected.sixteenths)
    assert torch.equal(captured.one_surface, expected.one_surface)


def test_stereo_matching_passes_opcheck(gpu):
    left, right = (each.to(gpu) for each in pair("texture", 12, 20))
    torch.library.opcheck(torch.ops.gsplat_core.match_disparities, (left, right, 0, 16))


def test_stereo_matching_rejects_images_on_two_devices(gpu):
    left, right = pair("texture", 12, 20)
    with pytest.raises(RuntimeError, match="must be on the same CUDA device"):
        match_disparities(left.to(gpu), right, 0, 16)
