"""Rendered optical flow: its error for motions with exact flow, and the effect of the loss `flow` on followed points.

    python benchmarks/methods/flow.py [--only motions|training] [--seeds 1] [--full] [--device cpu|cuda] [--out FILE]

Motions: a tilted wall of flat splats turns by 10 degrees, or turns and is stretched and sheared by 5 %. Errors are distances in
pixels from the exact flow, for both modes, at 320x256. Training: a synthetic recording with one eye at rest (depth from the light
source), or both eyes, offline without and with the loss. Points are the recording's tracked tissue points; their error is the
median in mm, after one scale for one eye; figures are medians over the seeds. `--full` trains at 640x512 for 2,500 steps.
"""

from __future__ import annotations

import math
import shutil
import statistics
import sys
import tempfile
import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import log
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import geometry_synthetic

from gsplat_core import Camera, Gaussians
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.truth import open_truth
from gsplat_core.rendering.flow import render_flow
from gsplat_core.scene.gaussians import rotations
from operators.applications.evaluate import SeenFromAnywhere, measure_geometry
from operators.applications.reconstruct import reconstruct
from operators.applications.replay import ReplaySettings
from operators.settings import Device

CAMERA = Camera.from_focal(350.0, 320, 256)
DISTANCE_MM, TILT_DEG, SPACING_MM = 100.0, 25.0, 1.0
STRETCH = ((1.05, 0.03, 0.0), (0.0, 0.96, 0.02), (0.01, 0.0, 1.04))
POINTS = {"fixed": "scaled", "stereo": "model", "poses": "model", "no-poses": "scaled"}
"""Alignment of the followed points by case: one scale where nothing tells the size of the scene."""
CENTRE = torch.tensor([0.0, 0.0, DISTANCE_MM], dtype=torch.float64)


def wall() -> Gaussians:
    """Flat splats at jittered places of a plane, turned by `TILT_DEG` about y."""
    a, b = torch.meshgrid(*(torch.arange(-70.0, 70, SPACING_MM),) * 2, indexing="xy")
    g = torch.Generator().manual_seed(0)
    a, b = (each.ravel() + 0.3 * torch.randn(each.numel(), generator=g) for each in (a, b))
    angle = math.radians(TILT_DEG)
    means = torch.stack([a * math.cos(angle), b, DISTANCE_MM + a * math.sin(angle)], 1)
    quats = torch.tensor([math.cos(angle / 2), 0, -math.sin(angle / 2), 0]).repeat(len(a), 1)
    scales = torch.tensor([0.8, 0.8, 0.005]).mul(SPACING_MM).log().repeat(len(a), 1)
    return Gaussians(means, quats, scales, torch.full((len(a),), 4.0), torch.zeros(len(a), 1, 3))


def quaternion(axis: tuple[float, float, float], angle_deg: float) -> Tensor:
    """Return a rotation as wxyz [4]."""
    half, direction = math.radians(angle_deg) / 2, torch.tensor(axis, dtype=torch.float64)
    return torch.cat([torch.tensor([math.cos(half)]).double(), math.sin(half) * direction / direction.norm()])


def moved(gaussians: Gaussians, turn: Tensor, matrix: Tensor, shift: Tensor) -> Gaussians:
    """Move by X -> CENTRE + matrix (X - CENTRE) + shift, and turn each splat by `turn`."""
    w, v = turn[0], turn[1:]
    x, u = gaussians.quats[:, :1].double(), gaussians.quats[:, 1:].double()
    quats = torch.cat([w * x - u @ v[:, None], w * u + x * v + torch.linalg.cross(v.expand_as(u), u)], 1)
    means = CENTRE + (gaussians.means.double() - CENTRE) @ matrix.T + shift
    return replace(gaussians, means=means.float(), quats=quats.float())


def exact(matrix: Tensor, shift: Tensor) -> Tensor:
    """Return the exact flow [H, W, 2] of the wall."""
    K = torch.tensor(CAMERA.K)
    y, x = torch.meshgrid(torch.arange(CAMERA.height_px) + 0.5, torch.arange(CAMERA.width_px) + 0.5, indexing="ij")
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1).double()
    depth = DISTANCE_MM / (1 - math.tan(math.radians(TILT_DEG)) * rays[..., :1])
    there = CENTRE + (rays * depth - CENTRE) @ matrix.T + shift
    pixels = there[..., :2] / there[..., 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    return pixels - torch.stack([x, y], -1)


def motions(device: str) -> dict[str, float]:
    """Return errors in pixels by motion and mode."""
    first, shift = wall(), torch.tensor([1.0, -0.5, 0.7], dtype=torch.float64)
    figures: dict[str, float] = {}
    worst: dict[str, list[Tensor]] = {}
    for axis in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, 1.0, -0.5)):
        turn = quaternion(axis, 10.0)
        rigid = rotations(turn[None])[0]
        for name, matrix in (("rigid", rigid), ("affine", rigid @ torch.tensor(STRETCH).double())):
            second = moved(first, turn, matrix, shift)
            for mode in ("neighbours", "gaussianflow"):
                found = render_flow(first.to(device), second.to(device), CAMERA, CAMERA, mode=mode)
                off = (found.flow.cpu() - exact(matrix, shift)).norm(dim=-1)
                worst.setdefault(f"{name}_{mode}", []).append(off.flatten())
    for name, errors in worst.items():
        together = torch.cat(errors)
        figures[f"{name}_median_px"] = round(float(together.median()), 6)
        figures[f"{name}_p95_px"] = round(float(torch.sort(together).values[int(0.95 * len(together))]), 6)
        figures[f"{name}_largest_px"] = round(float(together.max()), 6)
    return figures


def trained(case: str, seed: int, losses: tuple[str, ...], device: Device, full: bool, work: Path) -> dict[str, float]:
    """Train on one synthetic recording and return errors of followed points and depth."""
    size = (640, 512, 48, 20.0) if full else (160, 128, 24, 15.0)
    given = Namespace(
        scene="open", width=size[0], height=size[1], frames=size[2], fps=size[3], seed=seed, smoke=0.0,
        depth_noise=0.0, exposure_changes=False,
    )  # fmt: skip
    whole = geometry_synthetic.recording_of(geometry_synthetic.CASES[case], given, work)
    copied, run = work / f"{case}-given", work / f"{case}-run"
    geometry_synthetic.copy_of(whole, copied, geometry_synthetic.CASES[case])
    depth = "light" if case == "fixed" else "auto"
    settings = ReplaySettings(copied, run, device=device, sinks=(), seed=seed, depth=depth, losses=losses)
    begun = time.perf_counter()
    reconstruct(settings, 2500 if full else 250)
    seconds = time.perf_counter() - begun
    recording = open_recording(whole)
    geometry = measure_geometry(
        recording, recording.frame_count, recording.camera, load_bundle(run / "model").to(device),
        SeenFromAnywhere(device), open_truth(whole, recording.frame_count),
    )  # fmt: skip
    tracking, errors = geometry.tracking, geometry.depth
    third = next(view for view in geometry.views if view.name == "third").model.psnr_tissue_db
    assert tracking is not None and errors is not None and third is not None
    points = getattr(tracking, POINTS[case])
    return {
        "points_mm": round(points.median_mm, 4),
        "points_px": round(tracking.model.median_px, 4),
        "still_mm": round(tracking.still.median_mm, 4),
        "depth_share": round(errors.scaled_rmse_share, 5),
        "third_view_db": round(third, 3),
        "train_s": round(seconds, 1),
    }


def main() -> None:
    """Measure and log."""
    parser = log.options(__doc__)
    parser.add_argument("--only", choices=["motions", "training"], help="one of the two parts")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--cases", nargs="+", choices=list(POINTS), default=["fixed", "stereo"])
    parser.add_argument("--weight", type=float, default=0.0, help="weight of the loss; 0 for its default")
    chosen = parser.parse_args()
    figures: dict[str, object] = {}
    if chosen.only != "training":
        figures |= motions(chosen.device)
    by_seed: dict[str, list[float]] = {}
    loss = f"flow:{chosen.weight}" if chosen.weight else "flow"
    for case in () if chosen.only == "motions" else chosen.cases:
        for seed in range(chosen.seeds):
            work = Path(tempfile.mkdtemp(prefix="flow-"))
            try:
                for name, losses in (("today", ()), ("flow", (loss,))):
                    made = trained(case, seed, losses, chosen.device, chosen.full, work)
                    for key, value in made.items():
                        by_seed.setdefault(f"{case}_{name}_{key}", []).append(value)
            finally:
                shutil.rmtree(work)
    figures["by_seed"] = by_seed
    figures |= {name: round(statistics.median(values), 5) for name, values in by_seed.items()}
    log.write("flow", chosen, figures)


if __name__ == "__main__":
    main()
