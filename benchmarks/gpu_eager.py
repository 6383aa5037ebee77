"""Measure eager `rasterization()` calls on one NVIDIA GPU against gsplat's in the same process.

    python benchmarks/gpu_eager.py
    PYTHONPATH=build/peers python benchmarks/gpu_eager.py --scenes surgical50k_640x512 --packed

Both get the same tensors: RGB and expected depth of one camera; forward without gradients, and forward with the backward pass of a mean absolute difference. Prints one
JSON object per line with times (gpu_timing.py), launches on the GPU per call, and additional memory; the last line compares the pictures.
"""

from __future__ import annotations

import argparse

import torch
from gpu_scenes import SCENES
from gpu_splat import called, psnr_db
from gpu_timing import Times, compare, extra_mib, gsplat, measure, report, report_machine
from torch import Tensor

import gsplat_core

ASKED_MS = {"surgical50k_640x512": (0.35, 1.2), "volume1m_1080p": (0.9, 2.8)}
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


if __name__ == "__main__":
    main()
