"""Measure eager `rasterization()` calls on one NVIDIA GPU against gsplat's in the same process.

    python benchmarks/gpu_eager.py
    PYTHONPATH=build/peers python benchmarks/gpu_eager.py --scenes surgical50k_640x512 --packed

Both get the same tensors: RGB and expected depth of one camera; forward without gradients, and forward with the backward pass of a mean absolute difference. Prints one
JSON object per line with times (gpu_timing.py), launches on the GPU per call, and additional memory; the last line of a scene compares the pictures.

The last lines of the run are host times in microseconds of the parts of a call: until the call returns, median over calls that start with an idle GPU. In the scene of
one Gaussian nothing waits for the GPU. Native calls are those of `torch.ops.gsplat_core`; the rest of a call is Python and torch's autograd.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from gpu_scenes import SCENES, Scene, surgical
from gpu_splat import called, psnr_db
from gpu_timing import Times, compare, extra_mib, gsplat, measure, report, report_machine
from torch import Tensor

import gsplat_core
from gsplat_core.rendering.rasterization import next_capacity

ASKED_MS = {"surgical50k_640x512": (0.12, 0.6), "volume1m_1080p": (0.9, 2.8)}
"""Required times in ms: forward, and forward with backward."""


def run(name: str, repetitions: int, packed: bool) -> None:
    """Measure all figures of one scene."""
    scene = SCENES[name]()
    scene.arguments["packed"] = packed
    width, height = scene.size_px
    target = torch.rand(height, width, 4, generator=torch.Generator().manual_seed(2)).cuda()
    peer = gsplat()
    modules = {"ours": gsplat_core} | ({} if peer is None else {"gsplat": peer})
    times: dict[str, tuple[Times, Times]] = {}
    memory: dict[str, float] = {}
    pictures: dict[str, Tensor] = {}
    for module, home in modules.items():
        forward, step = called(home.rasterization, scene, target)
        pictures[module] = forward()[0]
        times[module] = measure(forward, repetitions), measure(step, repetitions)
        memory[f"{module}_mib"] = extra_mib(step)
    asked = ASKED_MS.get(name, (None, None))
    for k, work in enumerate(("forward", "forward+backward")):
        peers = {module: figures[k] for module, figures in times.items() if module != "ours"}
        compare(f"{name} {work}", times["ours"][k], peers, asked[k], packed=packed)
    report(f"{name} forward+backward extra memory", packed=packed, **memory)
    if peer is not None:
        report(f"{name} agreement", psnr_db=psnr_db(pictures["ours"], pictures["gsplat"]))


def host_us(work: Callable[[], object], prepare: Callable[[], object] = lambda: None, repetitions: int = 300) -> float:
    """Return the median time until `work` returns, in microseconds; `prepare` runs before each call, untimed."""
    times = []
    for _ in range(repetitions):
        prepare()
        torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        times.append(1e6 * (time.perf_counter() - start))
    return statistics.median(times[repetitions // 10 :])


def host_parts(name: str, scene: Scene) -> None:
    """Print the host times of the parts of a call."""
    width, height = scene.size_px
    arguments, leaves = scene.arguments, scene.leaves()
    target = torch.rand(height, width, 4, device="cuda")
    image = leaf = torch.zeros(1, height, width, 4, device="cuda", requires_grad=True)

    def forward() -> None:
        nonlocal image
        image = gsplat_core.rasterization(**(arguments | leaves))[0]

    def without_stored_gradients() -> None:
        for each in (leaf, *leaves.values()):
            each.grad = None

    def backward_prepared() -> None:
        without_stored_gradients()
        forward()

    def without_gradients() -> None:
        with torch.no_grad():
            gsplat_core.rasterization(**arguments)

    v_image = torch.ones_like(image)
    ops = torch.ops.gsplat_core
    given = [
        arguments[key] if key else None
        for key in ("means", "", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "", "")
    ]
    options, ranges = [width, height, 0, 3, 3, 2, 0, 0, 0, 0], [0.3, 0.01, 1e10, 0.0]
    length = len(ops.rasterize.default(given, [1], options, ranges, False)[9])
    sizes = ([1], [*options[:-1], next_capacity(0, length)], ranges)
    out = ops.rasterize.default(given, *sizes, True)
    own = out[11:]
    saved = [own[0], out[4], out[8], out[9], own[2], own[1], None, None, out[1], own[4], own[3]]
    v_records, v_means2d, _ = ops.rasterize_splats_backward.default(saved, v_image, None, *sizes)
    gradients = [v_records, v_means2d, None, None, None]
    needs = [key in leaves for key in ("means", "", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "", "")]
    report(
        f"{name} host time",
        forward_us=host_us(without_gradients),
        forward_native_us=host_us(lambda: ops.rasterize.default(given, *sizes, False)),
        forward_with_gradients_us=host_us(forward),
        forward_with_gradients_native_us=host_us(lambda: ops.rasterize.default(given, *sizes, True)),
        backward_us=host_us(lambda: image.backward(v_image), backward_prepared),
        backward_native_us=host_us(
            lambda: (
                ops.rasterize_splats_backward.default(saved, v_image, None, *sizes),
                ops.rasterize_inputs_backward.default(given, out[6], None, gradients, *sizes, needs),
            )
        ),
        loss_us=host_us(lambda: (leaf - target).abs().mean().backward(), without_stored_gradients),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--repetitions", type=int, default=50)
    parser.add_argument("--packed", action="store_true", help="packed=True, gsplat's default; otherwise packed=False")
    options = parser.parse_args()
    report_machine()
    for name in options.scenes:
        run(name, options.repetitions, options.packed)
        torch.cuda.empty_cache()
    for name, make in {
        "one_gaussian_16x16": lambda: surgical(1, 16, 16),
        **{name: SCENES[name] for name in options.scenes},
    }.items():
        host_parts(name, make())


if __name__ == "__main__":
    main()
