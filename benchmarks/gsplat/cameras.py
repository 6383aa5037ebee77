"""Figures of distorted lenses and rolling shutters: unscented means against OpenCV, covariances against sampling, and
pictures of a rolling shutter against pictures of each row."""

from __future__ import annotations

import math
import statistics
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import cv2
import numpy as np
import torch
from log import options, write
from torch import Tensor

from gsplat_core import RollingShutterType, fully_fused_projection, fully_fused_projection_with_ut, rasterization
from gsplat_core.poses.se3 import Shutter, exp
from gsplat_core.scene.distortion import Lens

WIDTH, HEIGHT = 640, 512
K = np.array([[520.0, 0, 322.0], [0, 518.0, 250.0], [0, 0, 1]])
COEFFICIENTS = {
    "pinhole": [-0.28, 0.11, 8e-4, -6e-4, -0.02, 0.01, 0.004, 0.0, 1e-3, -5e-4, 8e-4, 3e-4],
    "fisheye": [-0.04, 0.012, -0.005, 0.001],
}
SAMPLES = 400_000
TURN = (0.05, -0.02, 0.01, 0.004, 0.012, 0.02)
"""Motion during the read-out: translation in units of the scene, and rotation in radians."""


def scene(count: int, sigma_px: float, device: str, seed: int) -> dict[str, Any]:
    """Return Gaussians over the whole picture with standard deviations of about `sigma_px` pixels."""
    generator = torch.Generator().manual_seed(seed)
    random = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    pixels = random(count, 2) * torch.tensor([WIDTH - 40, HEIGHT - 40]) + 20
    depth = 3 + 4 * random(count, 1)
    made = {
        "pixels": pixels,
        "depth": depth,
        "quats": random(count, 4) - 0.5,
        "scales": sigma_px / K[0, 0] * depth * (0.4 + 1.2 * random(count, 3)),
        "opacities": 0.4 + 0.6 * random(count),
        "viewmats": torch.eye(4, dtype=torch.float64)[None],
        "Ks": torch.tensor(K)[None],
    }
    return {name: value.to(device) for name, value in made.items()}


def placed(made: dict[str, Any], lens: Lens, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
    """Return the Gaussians at the rays of their pixels, as arguments of the projection."""
    rays = lens.rays(made["pixels"][None], made["Ks"])
    means = rays.directions[0] / rays.directions[0, :, 2:] * made["depth"]
    given = {name: value for name, value in made.items() if name not in ("pixels", "depth")}
    return {name: value.to(dtype) for name, value in ({"means": means} | given).items()}


def lens_arguments(lens: Lens, dtype: torch.dtype) -> dict[str, Any]:
    values = {"radial_coeffs": lens.radial, "tangential_coeffs": lens.tangential, "thin_prism_coeffs": lens.thin_prism}
    return {"camera_model": lens.model} | {name: value.to(dtype) for name, value in values.items() if value is not None}


def means_and_covariances(model: str, device: str) -> dict[str, Any]:
    lens = Lens.from_opencv(COEFFICIENTS[model], model, dtype=torch.float64, device=device)
    given = placed(scene(4000, 1.0, device, 1), lens)
    found = fully_fused_projection_with_ut(**given, width=WIDTH, height=HEIGHT, **lens_arguments(lens, torch.float32))
    means, zero, coefficients = given["means"].double().cpu().numpy(), np.zeros(3), np.array(COEFFICIENTS[model])
    if model == "fisheye":
        expected = cv2.fisheye.projectPoints(means[None], zero, zero, K, coefficients)[0][0]
    else:
        expected = cv2.projectPoints(means, zero, zero, K, coefficients)[0][:, 0]
    seen = (found.radii[0, :, 0] > 0).cpu().numpy()
    apart = np.linalg.norm(found.means2d[0].double().cpu().numpy() - expected, axis=1)[seen]
    figures: dict[str, Any] = {
        f"{model}_means_seen": int(seen.sum()),
        f"{model}_mean_px_median": float(np.median(apart)),
        f"{model}_mean_px_worst": float(apart.max()),
    }
    for sigma_px in (1.0, 4.0):
        errors = covariance_errors(lens, sigma_px, device)
        figures[f"{model}_covariance_{sigma_px:g}px_median"] = statistics.median(errors)
        figures[f"{model}_covariance_{sigma_px:g}px_worst"] = max(errors)
    return figures


def covariance_errors(lens: Lens, sigma_px: float, device: str, count: int = 40) -> list[float]:
    """Return the relative errors (Frobenius norm) of unscented covariances against those of projected samples."""
    made = scene(count, sigma_px, device, 2)
    given = placed(made, lens)
    found = fully_fused_projection_with_ut(
        **given, width=WIDTH, height=HEIGHT, eps2d=0.0, **lens_arguments(lens, torch.float32)
    )
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(SAMPLES // 2, 3, generator=generator, dtype=torch.float64).to(device)
    noise = torch.cat([noise, -noise])
    errors = []
    for index in (found.radii[0, :, 0] > 0).nonzero().flatten().tolist():
        w, x, y, z = torch.nn.functional.normalize(given["quats"][index].double(), dim=0).tolist()
        turn = torch.tensor([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                             [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]).double().to(device)  # fmt: skip
        world = given["means"][index].double() + (noise * given["scales"][index].double()) @ turn.T
        pixels = lens.project(world[None], made["Ks"]).points[0]
        a, b, c = found.conics[0, index].double().tolist()
        covariance = torch.linalg.inv(torch.tensor([[a, b], [b, c]], dtype=torch.float64))
        expected = torch.cov(pixels.T).cpu()
        errors.append(float((covariance - expected).norm() / expected.norm()))
    return errors


def psnr(first: Tensor, second: Tensor) -> float:
    return -10 * math.log10(float((first - second).square().mean()))


def rolling_shutter(device: str) -> dict[str, Any]:
    """Return the PSNR of rolling pictures to pictures with the pose of each row, and of a global shutter to them."""
    width, height = WIDTH // 4, HEIGHT // 4
    made = scene(3000, 6.0, device, 4)
    given = placed(made, Lens())
    given["Ks"] = given["Ks"].clone()
    given["Ks"][:, :2] /= 4
    given["colors"] = torch.rand(3000, 3, generator=torch.Generator().manual_seed(5)).to(device)
    end = exp(torch.tensor([TURN], device=device)) @ given["viewmats"]
    kind = RollingShutterType.ROLLING_TOP_TO_BOTTOM
    shutter = Shutter.of(given["viewmats"], end, kind)
    figures: dict[str, Any] = {}
    middle = (given["means"] @ given["viewmats"][0, :3, :3].T)[..., :2] / given["means"][:, 2:]
    late = given["means"] @ end[0, :3, :3].T + end[0, :3, 3]
    moved = (late[:, :2] / late[:, 2:] - middle) * given["Ks"][0, 0, 0]
    figures["shutter_motion_px_median"] = float(moved.norm(dim=-1).median())
    with torch.no_grad():
        for name, eval3d in (("picture_plane", False), ("eval3d", True)):
            size = {"width": width, "height": height, "with_ut": True, "with_eval3d": eval3d}
            rolled = rasterization(**given, **size, rolling_shutter=kind, viewmats_rs=end)[0][0]
            rows = [
                rasterization(**given | {"viewmats": shutter.matrices(y / (height - 1))}, **size)[0][0, y]
                for y in range(height)
            ]
            still = rasterization(**given | {"viewmats": shutter.matrices()}, **size)[0][0]
            figures[f"shutter_{name}_psnr_db"] = psnr(rolled, torch.stack(rows))
            figures[f"shutter_{name}_global_psnr_db"] = psnr(still, torch.stack(rows))
    return figures


def inversion(device: str) -> dict[str, Any]:
    """Return the largest distance in pixels of a pixel from the projection of its ray, float32, all pixels."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(1, -1, 2).to(device)
    Ks = torch.tensor(K, dtype=torch.float32, device=device)[None]
    figures = {}
    for model, coefficients in COEFFICIENTS.items():
        lens = Lens.from_opencv(coefficients, model, dtype=torch.float32, device=device)
        rays = lens.rays(pixels, Ks)
        again = lens.project(rays.directions, Ks)
        apart = (again.points - pixels).norm(dim=-1)[rays.valid & again.valid]
        figures[f"{model}_pixels_seen_share"] = float(rays.valid.float().mean())
        figures[f"{model}_inversion_px_worst"] = float(apart.max())
    return figures


def times(device: str, count: int) -> dict[str, Any]:
    """Return the median time in ms of projecting Gaussians linearly and by the unscented transform, forward only."""
    lens = Lens.from_opencv(COEFFICIENTS["pinhole"], dtype=torch.float64, device=device)
    given = placed(scene(count, 2.0, device, 6), lens)
    more = lens_arguments(lens, torch.float32)

    def linear() -> None:
        fully_fused_projection(
            given["means"], None, given["quats"], given["scales"], given["viewmats"], given["Ks"], WIDTH, HEIGHT,
            opacities=given["opacities"],
        )  # fmt: skip

    def unscented() -> None:
        fully_fused_projection_with_ut(**given, width=WIDTH, height=HEIGHT, **more)

    figures: dict[str, Any] = {"timed_gaussians": count}
    for name, call in (("linear", linear), ("unscented", unscented)):
        taken = []
        with torch.no_grad():
            for _ in range(7):
                if device.startswith("cuda"):
                    torch.cuda.synchronize()
                start = time.perf_counter()
                call()
                if device.startswith("cuda"):
                    torch.cuda.synchronize()
                taken.append(1e3 * (time.perf_counter() - start))
        figures[f"{name}_ms"] = statistics.median(taken[2:])
    return figures


def main() -> None:
    chosen = options(__doc__ or "").parse_args()
    figures: dict[str, Any] = {}
    for model in COEFFICIENTS:
        figures |= means_and_covariances(model, chosen.device)
    figures |= inversion(chosen.device) | rolling_shutter(chosen.device)
    figures |= times(chosen.device, 200_000 if chosen.full else 20_000)
    write("cameras", chosen, figures, "gsplat")


if __name__ == "__main__":
    main()
