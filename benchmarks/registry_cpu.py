"""Measure upload, check and activation of a 50,000-Gaussian model version in the model registry.

    python benchmarks/registry_cpu.py [--gaussians 50000] [--runs 3]

Prints one JSON object for each run: processor time (its processes' as well) and time that passed, in seconds.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from gsplat_core.deformation import new_field
from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from services.registry.bundle_file import pack
from services.registry.models import ModelRegistry

WINDOW_S = (0.0, 5.0)


def save_model(folder: Path, count: int) -> None:
    """Save a sheet of Gaussians that fills a 640x512 picture, with a basis field."""
    random = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=random)
    means = draw(count, 3) * torch.tensor([20.0, 20.0, 3.0]) + torch.tensor([0.0, 0.0, 60.0])
    gaussians = Gaussians(means, draw(count, 4), draw(count, 3) * 0.2 - 0.5, draw(count), draw(count, 1, 3) * 0.3)
    field = new_field("basis", gaussians, WINDOW_S).detached_copy()
    save_bundle(Model(1, gaussians, field, Camera.from_focal(569.5, 640, 512), WINDOW_S), folder)


def processor_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def timed(call: Callable[[], object]) -> dict[str, float]:
    before_s, began_s = processor_s(), time.perf_counter()
    call()
    return {"processor_s": round(processor_s() - before_s, 3), "passed_s": round(time.perf_counter() - began_s, 3)}


def run(file: Path) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as folder, ModelRegistry(Path(folder)) as registry:
        return {
            "bytes": file.stat().st_size,
            "upload": timed(lambda: registry.upload("bench", file, None, "bench")),
            "check": timed(lambda: registry.check("bench", 1)),
            "activate": timed(lambda: registry.activate("bench", 1, None, "bench")),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        save_model(Path(folder) / "model", options.gaussians)
        file = Path(folder) / "model.isplat"
        pack(Path(folder) / "model", file)
        for _ in range(options.runs):
            print(json.dumps({"gaussians": options.gaussians, **run(file)}), flush=True)


if __name__ == "__main__":
    main()
