"""Measure a full training step on one NVIDIA GPU (deformation to optimiser update) against the same step on gsplat.

    python benchmarks/gpu_training.py
    python benchmarks/gpu_training.py --fields basis --repetitions 100

Masked L1 against a picture at 640x512, Adam over Gaussians and field, each step at another time. Ours is `TrainingStep`, which the reconstructor uses. The peer is plain
PyTorch on gsplat (peers/), with torch's fused Adam and with its default one; ratios are to the faster. Times are explained in gpu_timing.py. Prints one JSON object per
line.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from gpu_deformation import HEXPLANES, WINDOW_S, camera_of, moving
from gpu_scenes import Scene, surgical
from gpu_timing import Times, Work, compare, extra_mib, gsplat, measure, report_machine
from peers.deformation_plain import PlainBasis
from peers.training_on_gsplat import GsplatStep, Raw, first, with_basis, with_hexplane

from gsplat_core import Gaussians
from gsplat_core.deformation import BasisField, DeformationField, HexPlaneField
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep

BUMPS = 26


@dataclass(frozen=True)
class Case:
    """Kind of deformation field with its training scene."""

    gaussians: int
    degree: int
    """Degree of the spherical harmonics."""
    asked_ms: float


CASES = {
    "basis": Case(40_000, 0, 0.4),
    "small": Case(50_000, 0, 0.6),
    "85M": Case(50_000, 3, 2.5),
}


def observations(scene: Scene) -> list[Observation]:
    """Return one picture and tool mask as observations at several times."""
    width, height = scene.size_px
    g = torch.Generator().manual_seed(4)
    image = (torch.rand(height, width, 3, generator=g) * 255).to(torch.uint8).cuda()
    mask = torch.ones(height, width, dtype=torch.uint8)
    mask[: height // 3, : width // 4] = 0
    one = Observation(0, 0.0, camera_of(scene), image, mask.cuda(), None)
    return [dataclasses.replace(one, seq=k, time_s=at) for k, at in enumerate(torch.linspace(0.1, 5.9, 37).tolist())]


def new_field(kind: str, gaussians: Gaussians) -> DeformationField:
    if kind == "basis":
        return BasisField(gaussians.count, WINDOW_S, bumps=BUMPS).cuda()
    return moving(HexPlaneField(gaussians, WINDOW_S, **HEXPLANES[kind][0]))


def our_step(kind: str, scene: Scene, raw: Raw) -> Work:
    gaussians = Gaussians(*(tensor.clone() for tensor in raw))
    config = ReconstructorConfig(depth_weight=0.0)
    step = TrainingStep(gaussians, new_field(kind, gaussians), config, camera_of(scene))
    seen = itertools.cycle(observations(scene))
    for _ in range(3):
        step(next(seen))
    step.settle(next(seen))
    return lambda: step(next(seen))


def peer_step(kind: str, scene: Scene, raw: Raw, rasterization: Callable, *, fused_adam: bool) -> Work:
    if kind == "basis":
        field = PlainBasis(len(raw[0]), BUMPS)
        deform = with_basis(field)
    else:
        field = HEXPLANES[kind][1]()
        deform = with_hexplane(field, torch.stack([raw[0].amin(0), raw[0].amax(0)]))
    seen = observations(scene)
    target, mask = seen[0].image.float() / 255, seen[0].mask.float()
    step = GsplatStep(rasterization, scene, raw, deform, field, target, mask, fused_adam=fused_adam)
    at = itertools.cycle([one.time_s / WINDOW_S[1] for one in seen])
    return lambda: step(next(at))


def run(kind: str, repetitions: int) -> None:
    case = CASES[kind]
    scene = surgical(case.gaussians, 640, 512)
    raw = first(scene.raw(), case.gaussians, case.degree)
    peers: dict[str, Times] = {}
    memory: dict[str, float] = {}
    if (module := gsplat()) is not None:
        for name, fused in (("gsplat_fused_adam", True), ("gsplat", False)):
            work = peer_step(kind, scene, raw, module.rasterization, fused_adam=fused)
            peers[name] = measure(work, repetitions)
            memory[f"{name}_extra_mib"] = extra_mib(work)
            del work
            torch.cuda.empty_cache()
    ours = measure(our_step(kind, scene, raw), repetitions)
    compare(
        f"training step, {kind}, {case.gaussians} Gaussians of degree {case.degree}, 640x512",
        ours, peers, case.asked_ms, **memory,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fields", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--repetitions", type=int, default=50)
    options = parser.parse_args()
    torch.manual_seed(0)
    report_machine()
    for kind in options.fields:
        run(kind, options.repetitions)
        torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
