"""Depth of a narrow-baseline scene with and without a simulated range sensor.

    python benchmarks/methods/range_sensors.py [--steps N] [--full] [--device cpu|cuda] [--out FILE]

A textured relief is seen by eight cameras within 1 mm at a distance of 60 mm; the scope turns about its axis between them. Training starts from a plane. The sensor has 256
bins and Poisson noise; its true histograms come from the true depth maps. The depth-axis Chamfer distance is the mean of two
means of |z - z'|: over splats with an opacity above 0.1 to the true surface at their place, and over true points to the splat
nearest across the view.
"""

from __future__ import annotations

import math
import time

import log
import numpy as np
import torch

from gsplat_core.choices import SENSORS
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.scene.range_sensors import simulate_scan
from gsplat_core.training.losses import LossContext, WeightedLosses, loss_weights
from gsplat_core.training.measured_losses import RangeLoss, render_ranges
from gsplat_core.training.observations import Observation

DISTANCE, RELIEF, BASELINE, VIEWS = 60.0, 8.0, 1.0, 8
RATES = {"means": 0.06, "quats": 2e-3, "log_scales": 1e-2, "logit_opacities": 2e-2, "sh": 1e-2}


def surface(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return z of the relief in millimetres at x and y."""
    return DISTANCE + 0.5 * RELIEF * (
        torch.sin(0.16 * x + 0.5) * torch.cos(0.13 * y) + 0.4 * torch.sin(0.3 * y + 0.2 * x)
    )


def texture(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Return colours [N, 3], smooth with some contrast at 2 mm."""
    waves = [
        torch.sin(a * x + b * y + c) for a, b, c in ((1.1, 0.7, 0), (-0.6, 1.3, 1), (0.4, -0.9, 2), (1.9, 1.6, 0.5))
    ]
    base = torch.stack([waves[0], waves[1], waves[2]], -1)
    return (0.5 + 0.12 * base + 0.1 * waves[3][:, None]).clamp(0.02, 0.98)


def splats(x: torch.Tensor, y: torch.Tensor, z: torch.Tensor, colours: torch.Tensor, width: float) -> Gaussians:
    """Return round flat Gaussians in the picture plane."""
    count = len(x)
    return Gaussians(
        torch.stack([x, y, z], -1),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.tensor([width, width, 0.3 * width]).log().repeat(count, 1),
        torch.full((count,), 2.0),
        ((colours - 0.5) / SH_C0)[:, None],
    )


def grid(side: int, extent: float) -> tuple[torch.Tensor, torch.Tensor]:
    axis = torch.linspace(-extent, extent, side)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return x.reshape(-1), y.reshape(-1)


def chamfer(scene: Gaussians, extent: float) -> float:
    """Return the depth-axis Chamfer distance in millimetres inside the common view."""
    means = scene.means.detach().cpu()
    keep = (scene.opacities.detach().cpu() > 0.1) & (means[:, :2].abs() < extent).all(1)
    x, y, z = means[keep].unbind(1)
    forth = (z - surface(x, y)).abs().mean()
    true_x, true_y = grid(40, extent)
    nearest = torch.cdist(torch.stack([true_x, true_y], 1), means[keep][:, :2]).argmin(1)
    back = (z[nearest] - surface(true_x, true_y)).abs().mean()
    return float(0.5 * (forth + back))


def main() -> None:
    parser = log.options("Depth of a narrow-baseline scene with and without a range sensor.")
    parser.add_argument("--steps", type=int, default=0, help="0 for 300, or 1,200 with --full")
    parser.add_argument("--photons", type=float, default=1000.0, help="expected returns of a column")
    parser.add_argument("--weight", type=float, default=RangeLoss.default_weight)
    parser.add_argument("--also", default="", help="further losses, with and without a sensor; comma-separated")
    parser.add_argument("--sensors", default="time_of_flight,structured_light,oct_line")
    chosen = parser.parse_args()
    chosen.steps = chosen.steps or (1200 if chosen.full else 300)
    size, side = (256, 120) if chosen.full else (48, 30)
    device, extent = chosen.device, 26.0
    focal = size * 60.0 / 52.0
    cameras = []
    for view in range(VIEWS):
        # The scope turns about its axis by half a turn, and its tip moves on a circle.
        roll, around = math.pi * view / VIEWS, 2 * math.pi * view / VIEWS
        pose = np.eye(4)
        pose[:2, :2] = [[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]]
        centre = [0.5 * BASELINE * math.cos(around), 0.5 * BASELINE * math.sin(around), 0]
        pose[:3, 3] = -pose[:3, :3] @ np.array(centre)
        cameras.append(Camera(np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]]), size, size, pose))
    x, y = grid(2 * side, 36.0)
    truth = splats(x, y, surface(x, y), texture(x, y), 36.0 / side * 0.7).to(device)
    random = np.random.default_rng(0)
    with torch.no_grad():
        pictures = [render(truth, camera) for camera in cameras]
    depths = [np.where(p.alpha.cpu() > 0.5, p.depth.cpu(), 0).astype(np.float32) for p in pictures]
    images = [(p.image * 255).round().clamp(0, 255).to(torch.uint8) for p in pictures]

    def observations(sensor_name: str | None, photons: float) -> list[Observation]:
        sensor = None if sensor_name is None else SENSORS[sensor_name](DISTANCE - 20, DISTANCE + 30, 256)
        mask = torch.ones(size, size, dtype=torch.uint8, device=device)
        return [
            Observation(
                k, 0.0, camera, images[k], mask, None,
                ranges=None if sensor is None else simulate_scan(depths[k], camera, sensor, random, photons=photons),
            )
            for k, camera in enumerate(cameras)
        ]  # fmt: skip

    def train(sensor: str | None, photons: float, *, camera_weight: float = 1.0) -> tuple[float, float]:
        torch.manual_seed(0)
        x, y = grid(side, 34.0)
        colours = torch.full((len(x), 3), 0.5)
        scene = splats(x, y, torch.full_like(x, DISTANCE), colours, 34.0 / side).to(device).requires_grad_()
        groups = [{"params": [tensor], "lr": RATES[name], "name": name} for name, tensor in scene.tensors().items()]
        optimiser = torch.optim.Adam(groups, eps=1e-12)
        seen, names = observations(sensor, photons), [*filter(None, chosen.also.split(","))]
        losses = WeightedLosses(loss_weights(names if sensor is None else [*names, f"range:{chosen.weight}"]))
        context = LossContext(seen, lambda time_s: scene)
        start = time.perf_counter()
        for step in range(chosen.steps):
            one = seen[step % len(seen)]
            image = render(scene, one.camera, depth=False).image
            loss = camera_weight * (image - one.image.float() / 255).abs().mean()
            term = losses(scene, one, context)
            if term is not None:
                loss = loss + term
            for group in optimiser.param_groups:
                group["lr"] = RATES[group["name"]] * 0.02 ** (step / chosen.steps)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        return chamfer(scene, extent), (time.perf_counter() - start) / chosen.steps * 1e3

    start_x, start_y = grid(40, extent)
    figures: dict[str, object] = {
        "start_mm": round(float((surface(start_x, start_y) - DISTANCE).abs().mean()), 3),
        "camera_mm": None,
    }
    camera_mm, step_ms = train(None, 0.0)
    figures |= {"camera_mm": round(camera_mm, 3), "camera_step_ms": round(step_ms, 1)}
    for name in chosen.sensors.split(","):
        with_sensor, step_ms = train(name, chosen.photons)
        figures |= {
            f"{name}_mm": round(with_sensor, 3),
            f"{name}_ratio": round(with_sensor / camera_mm, 3),
            f"{name}_step_ms": round(step_ms, 1),
        }
    sensor = SENSORS["structured_light"](DISTANCE - 20, DISTANCE + 30, 256)
    with torch.no_grad():
        start = time.perf_counter()
        for _ in range(5):
            rendered = render_ranges(truth, cameras[0], sensor)
        rendered.sum().item()
        figures["render_ms"] = round((time.perf_counter() - start) * 200, 2)
    log.write("range_sensors", chosen, {"pixels": size, "splats": side * side, **figures})


if __name__ == "__main__":
    main()
