"""The operations behind `rasterization` as one chain: in CUDA graphs, on other streams and devices, compiled."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from gsplat_core import (
    InvalidInput,
    fully_fused_projection,
    quat_scale_to_covar_preci,
    rasterization,
    rasterize_to_pixels,
    spherical_harmonics,
)
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.rendering.pipeline import camera_centers


def place(scene, device="cuda", dtype=torch.float32):
    scene = scene.to(dtype)
    names = [f.name for f in fields(scene) if f.name not in ("width", "height")]
    return replace(scene, **{name: getattr(scene, name).to(device) for name in names})


def whole(scene, **options) -> list[Tensor]:
    """Image, alpha and the gradients of their weighted sum."""
    leaves = scene.leaves()
    image, alpha, _ = rasterization(*leaves, scene.Ks, scene.width, scene.height, sh_degree=3, packed=False, **options)
    weights = torch.linspace(-1, 1, image.numel(), device=image.device).view(image.shape)
    return [image.detach(), alpha.detach(), *torch.autograd.grad((image * weights).sum() + alpha.sum(), leaves)]


def assert_same_bits(seen, wanted) -> None:
    for s, w in zip(seen, wanted, strict=True):
        assert torch.equal(s.cpu(), w.cpu())


def test_plain_chain_captured_frame_and_gradient_follow_camera(make_scene):
    scene = place(make_scene(3000, width=200, height=120))
    opacities, grid = scene.opacities[None], TileGrid(16, math.ceil(200 / 16), math.ceil(120 / 16))

    def frame(capacity: int | None) -> tuple[list[Tensor], Tensor | None]:
        leaves = [t.detach().requires_grad_() for t in scene.leaves()]
        means, quats, scales, opacity, sh, views = leaves
        rows = fully_fused_projection(
            means, None, quats, scales, views, scene.Ks, scene.width, scene.height, opacities=opacity
        )
        visible = rows.radii[..., 0] > 0
        toward = means[None] - camera_centers(views)[:, None]
        colors = (spherical_harmonics(3, toward, sh, masks=visible) + 0.5).clamp_min(0)
        exact = {"conics": rows.conics, "opacities": opacities}
        lists = bin_splats(rows.means2d, rows.radii, rows.depths, grid, **exact, capacity=capacity)
        image, alphas = rasterize_to_pixels(
            rows.means2d, rows.conics, colors, opacity[None], scene.width, scene.height, 16, lists[2], lists[1]
        )
        gradients = torch.autograd.grad(image.square().sum() + alphas.sum(), leaves)
        return [image.detach(), alphas.detach(), *gradients], lists[3] if capacity is not None else None

    capacity = 2 * int(frame(0)[1])
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        frame(capacity)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):  # a host that waited would be refused here
        replayed, needed = frame(capacity)
    pictures = []
    for step in range(3):
        with torch.no_grad():
            scene.viewmats[0, :3, 3] += torch.tensor([0.2, -0.1, 0.3], device="cuda") * step
        graph.replay()
        assert needed.item() <= capacity
        assert_same_bits(replayed, frame(None)[0])
        pictures.append(replayed[0].clone())
    assert not torch.equal(pictures[0], pictures[2])


@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype")
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED", "D"])
@pytest.mark.parametrize("geometry", ["quats", "covars"])
def test_plain_chain_synchronises_for_list_length_only(make_scene, render_mode, geometry):
    scene = place(make_scene(300, cameras=2))
    leaves = scene.leaves()
    means, quats, scales, opacities, sh, viewmats = leaves
    options = dict(render_mode=render_mode, rasterize_mode="antialiased", packed=False, sh_degree=3)
    options["backgrounds"] = torch.rand(2, 1 if render_mode == "D" else 3, device="cuda")
    if geometry == "covars":
        quats = quat_scale_to_covar_preci(quats, scales, compute_preci=False)[0].detach().requires_grad_()
        options["covars"] = quats

    def step() -> None:
        given = (None, None) if geometry == "covars" else (quats, scales)
        image, alpha, _ = rasterization(
            means, *given, opacities, sh, viewmats, scene.Ks, scene.width, scene.height, **options
        )
        torch.autograd.grad(image.sum() + alpha.sum(), (means, quats, opacities, viewmats))

    step()
    torch.cuda.set_sync_debug_mode("error")  # knows of torch's own waits; that for the length is ours
    try:
        step()
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_plain_chain_on_side_stream_beside_busy_stream(make_scene):
    scene = place(make_scene(2000, cameras=2))
    wanted = whole(scene)
    matrix = torch.randn(4096, 4096, device="cuda")
    side, busy = torch.cuda.Stream(), torch.cuda.Stream()
    torch.cuda.synchronize()
    with torch.cuda.stream(busy):
        for _ in range(20):
            matrix = matrix @ matrix * 1e-4
    results = []
    with torch.cuda.stream(side):
        for _ in range(3):
            results.append(whole(scene, render_mode="RGB"))
    side.synchronize()
    for seen in results:
        assert_same_bits(seen, wanted)


def test_plain_chain_on_two_concurrent_streams(make_scene):
    scenes = [place(make_scene(3000, seed=seed)) for seed in range(2)]
    wanted = [whole(scene) for scene in scenes]
    streams = [torch.cuda.Stream() for _ in scenes]
    torch.cuda.synchronize()
    results: list[list[list[Tensor]]] = [[], []]
    for _ in range(5):
        for stream, scene, found in zip(streams, scenes, results, strict=True):
            with torch.cuda.stream(stream):
                found.append(whole(scene))
    torch.cuda.synchronize()
    for found, expected in zip(results, wanted, strict=True):
        for seen in found:
            assert_same_bits(seen, expected)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs a second GPU")
def test_plain_chain_on_second_device_while_first_is_current(make_scene):
    scene = make_scene(500, cameras=2)
    wanted = whole(place(scene, "cuda:0"))
    torch.cuda.set_device(0)
    seen = whole(place(scene, "cuda:1"))
    assert torch.cuda.current_device() == 0
    assert all(t.device.index == 1 for t in seen)
    assert_same_bits(seen, wanted)
    with pytest.raises(InvalidInput, match="one device"):
        whole(replace(place(scene, "cuda:0"), viewmats=scene.viewmats.float().to("cuda:1")))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_plain_chain_rejects_other_dtypes_by_name(make_scene, dtype):
    with pytest.raises(InvalidInput, match=f"float32, got {dtype}".replace(".", r"\.")):
        whole(place(make_scene(5), dtype=dtype))


def test_plain_chain_rejects_mixed_cpu_and_gpu_inputs(make_scene):
    scene = place(make_scene(5))
    for name in ("means", "opacities", "sh", "viewmats", "Ks"):
        with pytest.raises(InvalidInput, match="one device"):
            whole(replace(scene, **{name: getattr(scene, name).cpu()}))


@pytest.mark.filterwarnings("ignore")  # of torch's compiler, about its own parts
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_plain_chain_compiled_as_one_graph_equals_eager(make_scene, assert_compiled_equal, backend):
    scene = place(make_scene(60))

    def render(*leaves: Tensor) -> tuple[Tensor, Tensor]:
        options = dict(sh_degree=3, packed=False, render_mode="RGB+ED")
        return rasterization(*leaves, scene.Ks, scene.width, scene.height, **options)[:2]

    assert_compiled_equal(render, scene.leaves(), backend=backend, fullgraph=True)
