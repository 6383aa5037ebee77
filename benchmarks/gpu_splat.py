"""How fast one NVIDIA GPU rasterizes the scenes of the peers' measurements, and how that compares with gsplat if it is installed.

    python benchmarks/gpu_splat.py
    python benchmarks/gpu_splat.py --scenes volume1m_1080p --repetitions 100 --stages-only

Times are medians over CUDA events, in milliseconds, with the host's part of each call in them; the stages are timed on their own,
on splats that the CPU projected. Prints one JSON object per line.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import statistics
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import gsplat_core
from gsplat_core.ops.compositing.compositing import rasterize_to_pixels
from gsplat_core.ops.projection.projection import fully_fused_projection
from gsplat_core.ops.tiles.tiles import bin_splats

TILE_SIZE = 16
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


def surgical(count: int, width: int, height: int, seed: int = 0) -> dict[str, Any]:
    """Arguments of `rasterization`: a bumpy tissue-like surface, `count` flat and mostly opaque Gaussians of about 1.6 px."""
    g, focal_px = torch.Generator().manual_seed(seed), 560.0
    u, v = torch.rand(count, generator=g) * width, torch.rand(count, generator=g) * height
    z = 60 + 12 * torch.sin(u / 90) * torch.cos(v / 70) + 0.3 * torch.randn(count, generator=g)
    size_px = 1.6 * torch.exp(0.5 * torch.randn(count, 3, generator=g))
    quats = torch.tensor([1.0, 0, 0, 0]) + 0.3 * torch.randn(count, 4, generator=g)
    opacities = torch.sigmoid(1.5 + 1.5 * torch.randn(count, generator=g))
    sh = 0.1 * torch.randn(count, 16, 3, generator=g)
    sh[:, 0] += torch.tensor([1.0, -0.4, -0.6])
    flat = torch.tensor([1.0, 1.0, 0.3])
    return _scene(u, v, z, focal_px, size_px * flat, quats, opacities, sh, width, height)


def volume(count: int, width: int, height: int, seed: int = 1) -> dict[str, Any]:
    """Arguments of `rasterization`: Gaussians of log-normal screen size (median 1.2 px) through a deep frustum."""
    g, focal_px = torch.Generator().manual_seed(seed), 1400.0
    u = torch.rand(count, generator=g) * width * 1.2 - 0.1 * width
    v = torch.rand(count, generator=g) * height * 1.2 - 0.1 * height
    z = torch.exp(torch.rand(count, generator=g) * 3.0) * 2
    size_px = 1.2 * torch.exp(0.9 * torch.randn(count, 3, generator=g)).clamp(max=60)
    quats = torch.randn(count, 4, generator=g)
    opacities = torch.sigmoid(2.0 * torch.randn(count, generator=g))
    sh = 0.1 * torch.randn(count, 16, 3, generator=g)
    sh[:, 0] += torch.randn(count, 3, generator=g)
    return _scene(u, v, z, focal_px, size_px, quats, opacities, sh, width, height)


def _scene(
    u: Tensor,
    v: Tensor,
    z: Tensor,
    focal_px: float,
    size_px: Tensor,
    quats: Tensor,
    opacities: Tensor,
    sh: Tensor,
    width: int,
    height: int,
) -> dict[str, Any]:
    return {
        "means": torch.stack([(u - width / 2) / focal_px * z, (v - height / 2) / focal_px * z, z], -1),
        "quats": torch.nn.functional.normalize(quats, dim=-1),
        "scales": size_px * (z / focal_px)[:, None],
        "opacities": opacities,
        "colors": sh,
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]]]),
        "width": width,
        "height": height,
        "sh_degree": 3,
        "packed": False,
        "render_mode": "RGB+ED",
    }


SCENES: dict[str, Callable[[], dict[str, Any]]] = {
    "surgical50k_640x512": lambda: surgical(50_000, 640, 512),
    "surgical200k_1280x1024": lambda: surgical(200_000, 1280, 1024),
    "volume1m_1080p": lambda: volume(1_000_000, 1920, 1080),
}


def milliseconds(function: Callable[[], object], repetitions: int, warm_up: int = 5) -> float:
    """Median time between two events around a call."""
    for _ in range(warm_up):
        function()
    torch.cuda.synchronize()
    times = []
    for _ in range(repetitions):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        function()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def on_gpu(scene: dict[str, Any]) -> dict[str, Any]:
    return {name: value.cuda() if isinstance(value, Tensor) else value for name, value in scene.items()}


def whole(
    rasterization: Callable[..., Any], scene: dict[str, Any], repetitions: int
) -> tuple[dict[str, float], Tensor]:
    """Forward, forward and backward, and the memory that the latter takes beyond the parameters'; and the image."""
    scene = on_gpu(scene)

    def forward() -> Tensor:
        with torch.no_grad():
            return rasterization(**scene)[0]

    times = {"forward_ms": milliseconds(forward, repetitions)}
    leaves = {name: scene[name].clone().requires_grad_() for name in PARAMETERS}
    target = torch.rand(1, scene["height"], scene["width"], 4, device="cuda")

    def step() -> None:
        image, _, _ = rasterization(**(scene | leaves))
        (image - target).abs().mean().backward()
        for leaf in leaves.values():
            leaf.grad = None

    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    times["forward_backward_ms"] = milliseconds(step, repetitions)
    times["extra_mib"] = (torch.cuda.max_memory_allocated() - before) / 2**20
    return times, forward()


def stages(scene: dict[str, Any], repetitions: int) -> dict[str, float]:
    """Tile lists, compositing and its gradient alone: four channels, as colour and depth have."""
    width, height = scene["width"], scene["height"]
    rows = fully_fused_projection(
        scene["means"], None, scene["quats"], scene["scales"], scene["viewmats"], scene["Ks"], width, height,
        opacities=scene["opacities"],
    )  # fmt: skip
    means2d, radii, depths, conics = (t.cuda() for t in (rows.means2d, rows.radii, rows.depths, rows.conics))
    opacities = scene["opacities"][None].cuda()
    colors = torch.rand(*depths.shape, 4, device="cuda")
    grid = (TILE_SIZE, math.ceil(width / TILE_SIZE), math.ceil(height / TILE_SIZE))

    def lists() -> tuple[Tensor, Tensor, Tensor]:
        return bin_splats(means2d, radii, depths, *grid, conics=conics, opacities=opacities)

    _, flatten_ids, offsets = lists()
    splats = (means2d, conics, colors, opacities)

    def blend(*inputs: Tensor) -> Tensor:
        return rasterize_to_pixels(*inputs, width, height, TILE_SIZE, offsets, flatten_ids)[0]

    leaves = [t.detach().requires_grad_() for t in splats]
    image = blend(*leaves)
    weights = torch.rand_like(image)
    return {
        "instances": flatten_ids.numel(),
        "bin_splats_ms": milliseconds(lists, repetitions),
        "composite_ms": milliseconds(lambda: blend(*splats), repetitions),
        "composite_backward_ms": milliseconds(
            lambda: torch.autograd.grad(image, leaves, weights, retain_graph=True), repetitions
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--repetitions", type=int, default=50)
    parser.add_argument("--stages-only", action="store_true")
    options = parser.parse_args()
    machine = {"device": torch.cuda.get_device_name(), "torch": torch.__version__}
    modules: dict[str, Callable[..., Any]] = {"gsplat_core": gsplat_core.rasterization}
    if importlib.util.find_spec("gsplat") is not None:
        modules["gsplat"] = importlib.import_module("gsplat").rasterization

    def report(scene: str, module: str, figures: dict[str, float]) -> None:
        rounded = {name: round(value, 4) for name, value in figures.items()}
        print(json.dumps({"scene": scene, "module": module} | rounded | machine), flush=True)

    for name in options.scenes:
        scene = SCENES[name]()
        report(name, "gsplat_core stages", stages(scene, options.repetitions))
        if options.stages_only:
            continue
        images = {}
        for module, rasterization in modules.items():
            figures, images[module] = whole(rasterization, scene, options.repetitions)
            report(name, module, figures)
        if "gsplat" in images:
            error = (images["gsplat"] - images["gsplat_core"])[..., :3].square().mean()
            report(name, "agreement", {"rgb_psnr_db": float(-10 * torch.log10(error))})


if __name__ == "__main__":
    main()
