"""Measure how fast one NVIDIA GPU deforms Gaussians, with and without rendering, against plain PyTorch and gsplat.

    python benchmarks/gpu_deformation.py
    python benchmarks/gpu_deformation.py --fields 85M --repetitions 100

HexPlane with a network in G-SHARP's size (85 million parameters) and a small one, and the basis field; every call is at another
time. Times are explained in gpu_timing.py. Prints one JSON object per line.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator

import torch
from gpu_scenes import Scene, surgical
from gpu_timing import Times, captured, compare, gsplat, measure, report, report_machine
from peers.deformation_plain import PlainBasis, PlainHexPlane, gsharp, small
from peers.training_on_gsplat import with_hexplane
from torch import Tensor

from gsplat_core import Camera, Gaussians, render
from gsplat_core.deformation import BasisField, DeformationField, HexPlaneField
from gsplat_core.rendering.alpha import FrameRenderer, Precision

WINDOW_S = (0.0, 6.0)
HEXPLANES = {
    "85M": ({"channels": 64, "resolution": (64, 64, 64, 100), "levels": (1, 2, 4, 8), "width": 32, "depth": 2}, gsharp),
    "small": ({"channels": 32, "resolution": (64, 64, 64, 25), "levels": (1, 2), "width": 64, "depth": 3}, small),
}
"""Configuration of both fields, of equal size. G-SHARP has a hidden layer per head; here all heads share one."""
KEPT: dict[Precision, torch.dtype] = {"fp32": torch.float32, "fp16": torch.float16}
ASKED_MS = {("85M", 50_000): 0.10}


def times_s() -> Iterator[float]:
    """Yield times within the window endlessly."""
    return itertools.cycle(torch.linspace(0.1, 5.9, 37).tolist())


def moving(field: HexPlaneField) -> HexPlaneField:
    """Return a field with small random deformations, since an untrained one is the identity."""
    with torch.no_grad():
        weights = torch.randn(field.head.weight.shape, generator=torch.Generator().manual_seed(3))
        field.head.weight.copy_(1e-3 * weights)
    return field.cuda()


def camera_of(scene: Scene) -> Camera:
    pose, intrinsics = (tensor.cpu().double().numpy() for tensor in scene.camera)
    return Camera(intrinsics, *scene.size_px, pose)


def deltas_alone(field: DeformationField, gaussians: Gaussians, repetitions: int, dtype: torch.dtype) -> Times:
    """Time the field's deltas alone, at a time that changes in device memory between graph replays."""
    time = torch.zeros(1, device="cuda")
    deltas = field.frame_deltas(gaussians, dtype)
    with torch.no_grad():
        return measure(captured(lambda: deltas(time)), repetitions)


def with_picture(
    field: DeformationField, gaussians: Gaussians, camera: Camera, repetitions: int, precision: Precision = "fp32"
) -> tuple[Times, float]:
    """Time `FrameRenderer` at a new time per frame; also returns the PSNR of its picture against the float32 ops."""
    renderer = FrameRenderer(gaussians, camera, field, precision=precision)
    at = times_s()
    picture = renderer.render(time_s=2.5).result().image
    with torch.no_grad():
        expected = render(field(gaussians, 2.5), camera).image
    psnr_db = float(-10 * torch.log10((picture - expected).square().mean()))
    return measure(lambda: renderer.render(time_s=next(at)), repetitions), psnr_db


def peer_times(
    scene: Scene, field: PlainHexPlane, rasterization: Callable | None, repetitions: int
) -> tuple[Times, Times | None]:
    """Time the plain PyTorch network alone and with gsplat's rendering."""
    raw = scene.raw()
    box = torch.stack([raw[0].amin(0), raw[0].amax(0)])
    deform = with_hexplane(field, box)
    at = times_s()

    @torch.no_grad()
    def network() -> tuple[Tensor, ...]:
        return deform(raw, next(at) / WINDOW_S[1])

    @torch.no_grad()
    def picture() -> Tensor:
        means, quats, log_scales, logit_opacities, sh = network()
        now = {"means": means, "quats": quats, "scales": log_scales.exp(), "opacities": logit_opacities.sigmoid()}
        assert rasterization is not None
        return rasterization(**(scene.arguments | now | {"colors": sh}))[0]

    return measure(network, repetitions), None if rasterization is None else measure(picture, repetitions)


def hexplane(size: str, count: int, repetitions: int) -> None:
    settings, new_peer = HEXPLANES[size]
    scene = surgical(count, 640, 512)
    gaussians = Gaussians(*scene.raw())
    field = moving(HexPlaneField(gaussians, WINDOW_S, **settings))
    module = gsplat()
    plain, plain_picture = peer_times(scene, new_peer(), None if module is None else module.rasterization, repetitions)
    for precision, dtype in KEPT.items():
        ours = deltas_alone(field, gaussians, repetitions, dtype)
        compare(f"deform, hexplane {size}, {precision}, {count} Gaussians", ours, {"plain": plain})
        picture, psnr_db = with_picture(field, gaussians, camera_of(scene), repetitions, precision)
        compare(
            f"deform and render, hexplane {size}, {precision}, {count} Gaussians, 640x512",
            picture,
            {} if plain_picture is None else {"plain_on_gsplat": plain_picture},
            ASKED_MS.get((size, count)),
            psnr_to_float32_db=psnr_db,
        )


def basis(count: int, repetitions: int) -> None:
    """Return a basis field with 26 bumps per Gaussian."""
    scene = surgical(count, 640, 512)
    gaussians = Gaussians(*scene.raw())
    field = BasisField(count, WINDOW_S, bumps=26)
    with torch.no_grad():
        field.weights.normal_(std=1e-3, generator=torch.Generator().manual_seed(3))
    field.cuda()
    peer, at = PlainBasis(count, 26), times_s()

    @torch.no_grad()
    def plain() -> Tensor:
        return peer(next(at) / WINDOW_S[1])

    compare(
        f"deform, basis field, {count} Gaussians",
        deltas_alone(field, gaussians, repetitions, torch.float32),
        {"plain": measure(plain, repetitions)},
    )
    picture, psnr_db = with_picture(field, gaussians, camera_of(scene), repetitions)
    report(f"deform and render, basis field, {count} Gaussians, 640x512", ours=picture, psnr_to_float32_db=psnr_db)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fields", nargs="*", default=[*HEXPLANES, "basis"], choices=[*HEXPLANES, "basis"])
    parser.add_argument("--repetitions", type=int, default=50)
    options = parser.parse_args()
    torch.manual_seed(0)
    report_machine()
    for kind in options.fields:
        if kind == "basis":
            basis(40_000, options.repetitions)
        else:
            for count in (50_000, 200_000):
                hexplane(kind, count, options.repetitions)


if __name__ == "__main__":
    main()
