"""Blending of surfels on CUDA, forward and backward, against plain torch in float64 and against the CPU."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import rasterization_2dgs, rasterize_to_pixels_2dgs
from tests.gsplat_core.ops.surfel_scenes import BLENDED, INPUTS, blend_scene, close, surfel_scene


def assert_close(scene, gpu, *, absgrad=False):
    close(scene.run(device=gpu, absgrad=absgrad), scene.run(torch.float64, absgrad=absgrad), 1e-3)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 8, 9, 16, 35])
def test_surfel_blending_with_any_number_of_channels(gpu, channels):
    s = surfel_scene(60, 40, 33, channels=channels)
    scene = blend_scene(s, backgrounds=torch.rand(1, channels, dtype=torch.float64))
    assert_close(scene, gpu, absgrad=channels <= 16)


@pytest.mark.parametrize(("tile_size", "size"), [(4, (9, 7)), (16, (1, 1)), (20, (33, 50)), (33, (40, 40))])
def test_surfel_blending_with_any_tile_and_image_size(gpu, tile_size, size):
    s = surfel_scene(60, *size, cameras=2)
    assert_close(blend_scene(s, tile_size=tile_size, backgrounds=torch.rand(2, 4, dtype=torch.float64)), gpu)


@pytest.mark.parametrize("count", [0, 1])
def test_surfel_blending_of_few_surfels(gpu, count):
    assert_close(blend_scene(surfel_scene(count)), gpu)


def test_surfel_blending_of_opaque_surfels_with_masks(gpu):
    s = surfel_scene(150, 40, 33, scale=0.5)
    s.opacities[::2] = 1.0
    masks = torch.ones(1, 3, 3, dtype=torch.bool)
    masks[0, 1, 1] = False
    assert_close(blend_scene(s, masks=masks), gpu)


def test_surfel_blending_skips_non_finite_surfels_without_gradient(gpu):
    lists = tuple(tensor.to(gpu) for tensor in blend_scene(surfel_scene(60)).lists())
    s = blend_scene(surfel_scene(60))
    s.means2d[0, 0, 1] = s.ray_transforms[0, 1, 2, 0] = s.colors[0, 2, 0] = s.normals[0, 3, 2] = float("nan")
    s.opacities[0, 4] = float("inf")
    seen = s.run(device=gpu, lists=lists)
    for name in (*BLENDED, *(f"v_{name}" for name in INPUTS)):
        assert seen[name].isfinite().all(), name
    for name in INPUTS:
        assert not seen[f"v_{name}"][:, :5].any(), name


def test_surfel_blending_of_large_scene_equals_cpu_and_is_deterministic(gpu):
    s = blend_scene(surfel_scene(20_000, 640, 512, scale=0.02))
    first, second, cpu = s.run(device=gpu, absgrad=True), s.run(device=gpu, absgrad=True), s.run(absgrad=True)
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
        error = (value.cpu() - cpu[name]).norm()
        assert error <= 5e-3 * cpu[name].norm(), (name, float(error / cpu[name].norm()))


def test_surfel_blending_skips_indices_out_of_range(gpu):
    s = blend_scene(surfel_scene(20))
    inputs = s.to(torch.float32, gpu)
    offsets, ids = (tensor.to(gpu) for tensor in s.lists())
    broken = ids.clone()
    broken[::3] = 2**30
    broken[1::3] = -5
    image, *_ = rasterize_to_pixels_2dgs(*inputs.values(), s.width, s.height, s.tile_size, offsets, broken)
    image.sum().backward()
    assert all(bool(value.grad.isfinite().all()) for name, value in inputs.items())


def test_surfel_blending_captured_in_graph(gpu):
    s = blend_scene(surfel_scene(200))
    inputs = s.to(torch.float32, gpu)
    lists = [tensor.to(gpu) for tensor in s.lists()]

    def step():
        image, alphas, normals, distortions, medians = rasterize_to_pixels_2dgs(
            *inputs.values(), s.width, s.height, s.tile_size, *lists
        )
        loss = image.sum() + distortions.sum() + normals.square().sum()
        return image, alphas, medians, *torch.autograd.grad(loss, list(inputs.values()))

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


def test_surfel_rendering_equals_cpu(gpu):
    s = surfel_scene(300, 64, 48, cameras=2)
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    tensors = {name: getattr(s, name).float() for name in names}
    for options in ({"render_mode": "RGB+ED"}, {"packed": True, "render_mode": "RGB+D"}):
        cpu = rasterization_2dgs(**tensors, width=s.width, height=s.height, **options)
        seen = rasterization_2dgs(
            **{name: value.to(gpu) for name, value in tensors.items()}, width=s.width, height=s.height, **options
        )
        for value, wanted in zip(seen[:6], cpu[:6], strict=True):
            assert (value.cpu() - wanted).norm() <= 1e-3 * wanted.norm() + 1e-4
