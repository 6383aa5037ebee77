"""Ray depth, normals and semantics: exactness on walls, cost of a training step, accuracy after training, and labels.

    python benchmarks/methods/surface.py [wall] [step] [stereo] [semantics] [--full] [--device cpu|cuda] [--out FILE]

* wall: largest relative depth error of a wall of flat splats, seen at a tilt of 0 to 60 degrees.
* step: time of a training step with and without the losses, on synthetic pictures.
* stereo: offline reconstruction of a synthetic stereo recording with and without the losses. Depth error of the centres' depth
  and of the ray depth relative to the median depth, mean angle of normals, PSNR in a third camera that training never sees.
* semantics: intersection over union of three classes on frames without labels, trained with labels on one frame in ten.
"""

from __future__ import annotations

import math
import statistics
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import log
import numpy as np
import torch

from gsplat_core import Camera, Gaussians, render
from gsplat_core.deformation import BasisField
from gsplat_core.evaluation.depth import DepthShareSums, NormalSums
from gsplat_core.evaluation.geometry import _is_chosen, _known
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.synthetic.scene import Extras
from gsplat_core.io.recordings.truth import open_truth
from gsplat_core.rendering.surface import render_surface
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.losses import EVERY
from gsplat_core.training.observations import Observation
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.steps.step import TrainingStep
from operators.applications.evaluate import SeenFromAnywhere, measure_geometry
from operators.applications.reconstruct import reconstruct
from operators.applications.replay import ReplaySettings

PARTS = ("wall", "step", "stereo", "semantics")
WARM_UP = EVERY
"""Untimed steps."""
TRAINED = ("ray_depth", "normal_consistency")


def wall(device: str) -> dict[str, Any]:
    """Return the largest errors in percent of flat splats on a tilted plane, over pixels that the plane covers."""
    figures: dict[str, Any] = {}
    camera = Camera.from_focal(50.0, 45, 37)
    for tilt in (0, 20, 35, 50, 60):
        angle = math.radians(tilt)
        a, b = torch.meshgrid(torch.arange(-120.0, 241), torch.arange(-60.0, 61), indexing="xy")
        a, b = a.ravel(), b.ravel()
        means = torch.stack([a * math.cos(angle), b, 40 + a * math.sin(angle)], 1)
        quats = torch.tensor([math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0]).repeat(len(means), 1)
        scales = torch.tensor([1.0, 1.0, 0.02]).log().repeat(len(means), 1)
        scene = Gaussians(means, quats, scales, torch.full((len(means),), 6.0), torch.zeros(len(means), 1, 3)).to(
            device
        )
        ray_x = (torch.arange(camera.width_px) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
        exact = (40 / (1 - math.tan(angle) * ray_x)).expand(camera.height_px, -1).to(device)
        surface, picture = render_surface(scene, camera), render(scene, camera)
        seen = (exact > 0) & (exact < 150) & (surface.alpha > 0.99)
        for name, depth in (("ray", surface.ray_depth), ("median", surface.median_depth), ("centre", picture.depth)):
            off = ((depth - exact).abs() / exact)[seen]
            figures[f"wall {tilt} deg: {name} depth, largest error %"] = round(100 * float(off.max()), 4)
    return figures


def step(device: str, full: bool) -> dict[str, Any]:
    """Return the time of a step in ms without and with the losses, and the extra cost."""
    size = (640, 512) if full or device != "cpu" else (320, 256)
    count = 20_000 if full or device != "cpu" else 8_000
    with tempfile.TemporaryDirectory() as folder:
        synthesize(Path(folder) / "made", frames=4, width_px=size[0], height_px=size[1], extras=Extras())
        recording = open_recording(Path(folder) / "made")
        frame = next(iter(recording))
        truth = open_truth(Path(folder) / "made", recording.frame_count)
        frame = frame.with_fields(depth=truth.depth_of(frame))
        observation = Observation.of(frame, recording.camera, device)
        figures: dict[str, Any] = {"step: size": f"{size[0]}x{size[1]}, {count} Gaussians"}
        makers = {}
        for name, losses in {"none": (), "both": TRAINED, "ray_depth": TRAINED[:1], "normals": TRAINED[1:]}.items():
            gaussians = gaussians_from_frame(frame, recording.camera, count, sh_degree=0, default_depth_mm=60.0)
            field = BasisField(gaussians.count, (0.0, 1.0))
            config = ReconstructorConfig(gaussians=count, losses=losses)
            makers[name] = TrainingStep(gaussians.to(device), field.to(device), config, recording.camera)
        times: dict[str, list[float]] = {name: [] for name in makers}
        clock = time.process_time if device == "cpu" else time.perf_counter  # other load of the machine does not count
        for turn in range(WARM_UP + EVERY * (6 if device == "cpu" else 25)):
            for name, one in makers.items():
                begun = clock()
                one(observation)
                if device != "cpu":
                    torch.cuda.synchronize()
                if turn >= WARM_UP:
                    times[name].append(1e3 * (clock() - begun))
        # Losses of rays are evaluated in one of `EVERY` steps: the median of the means of as many.
        means = {
            name: [statistics.mean(each[k : k + EVERY]) for k in range(0, len(each), EVERY)]
            for name, each in times.items()
        }
        for name, each in means.items():
            figures[f"step: losses {name}, ms"] = round(statistics.median(each), 3)
        for name in ("both", "ray_depth", "normals"):
            ratio = statistics.median(means[name]) / statistics.median(means["none"])
            figures[f"step: extra cost of {name} %"] = round(100 * (ratio - 1), 1)
    return figures


def stereo(device: str, full: bool, choices: dict[str, tuple[str, ...]], seeds: int, steps: int) -> dict[str, Any]:
    """Return the geometry after offline reconstruction of two eyes at rest, means over the seeds."""
    width, height = (640, 512) if full else (160, 128)
    figures: dict[str, Any] = {"stereo: recording": f"{width}x{height}, 36 frames, {steps} steps, {seeds} seeds"}
    means: dict[str, list[float]] = {}
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            whole = Path(folder) / "whole"
            synthesize(
                whole, frames=36, width_px=width, height_px=height, fps=15.0, seed=seed, camera="fixed",
                extras=Extras(third=True),
            )  # fmt: skip
            given = _without_truth(whole, Path(folder) / "given")
            for name, losses in choices.items():
                run = Path(folder) / f"run-{len(means)}-{name}".replace(":", "_").replace(",", "-")
                settings = ReplaySettings(
                    given,
                    run,
                    device="cpu" if device == "cpu" else "cuda",
                    sinks=(),
                    seed=seed,
                    depth="stereo",
                    losses=losses,
                )
                begun = time.perf_counter()
                reconstruct(settings, steps)
                seconds = time.perf_counter() - begun
                for key, value in _accuracy(whole, load_bundle(run / "model").to(device), device).items():
                    means.setdefault(f"stereo: {name}, {key}", []).append(value)
                means.setdefault(f"stereo: {name}, training s", []).append(seconds)
                print({key: round(values[-1], 3) for key, values in means.items()}, file=sys.stderr, flush=True)
    return figures | {name: round(statistics.mean(values), 3) for name, values in means.items()}


def _without_truth(whole: Path, given: Path) -> Path:
    """Copy pictures, masks and calibration of both eyes; the copy has no depth."""
    import json
    import shutil

    given.mkdir()
    for name in ("images", "masks", "images_right"):
        shutil.copytree(whole / name, given / name)
    description = json.loads((whole / "recording.json").read_text())
    kept = ("format", "version", "fps", "camera", "depth_unit_mm", "stereo_baseline_mm")
    (given / "recording.json").write_text(json.dumps({key: description[key] for key in kept}))
    return given


def _accuracy(whole: Path, model: Any, device: str) -> dict[str, float]:
    recording = open_recording(whole)
    truth = open_truth(whole, recording.frame_count)
    sums = {name: (DepthShareSums(), NormalSums()) for name in ("centre depth", "ray depth")}
    own: list[float] = []
    for frame in recording:
        if not _is_chosen(frame, recording.frame_count, 12):
            continue
        true = truth.depth_of(frame)
        assert true is not None
        surface, picture = model.surface(frame.time_s, recording.camera), model.render(frame.time_s, recording.camera)
        angle = _normal_angle(surface.normals.cpu().numpy(), recording.camera, true, _known(frame, true))
        own.append(angle)
        for name, plane in (("centre depth", picture.depth), ("ray depth", surface.ray_depth)):
            for each in sums[name]:
                each.add(recording.camera, true, plane.cpu().numpy(), _known(frame, true))
    figures: dict[str, float] = {}
    for name, (depth, normals) in sums.items():
        assert depth.errors is not None and normals.errors is not None
        figures[f"{name}, RMS %"] = 100 * depth.errors.rmse_share
        figures[f"normals of {name}, mean deg"] = normals.errors.mean_deg
    figures["normals of splats, mean deg"] = statistics.mean(own)
    pictures = SeenFromAnywhere(device)
    geometry = measure_geometry(recording, recording.frame_count, recording.camera, model, pictures, truth, None)
    third = next(view for view in geometry.views if view.name == "third")
    assert third.model.psnr_tissue_db is not None
    figures["third view, dB"] = third.model.psnr_tissue_db
    return figures


def _normal_angle(shown: np.ndarray, camera: Camera, true: np.ndarray, known: np.ndarray) -> float:
    from gsplat_core.evaluation.depth import normals_of

    right, both = normals_of(camera, true, known)
    both = both & (np.abs(shown).sum(-1) > 0)
    cosine = (right[both] * shown[both]).sum(-1)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


CLASSES = ("tissue", "tool", "background")


def semantics(device: str, full: bool) -> dict[str, Any]:
    """Return intersection over union per class, trained from pictures, depth and labels on one frame in ten.

    Tissue rises and falls by 4 mm in 2 s in front of a wall, and a tool moves by 12 mm across it. The pictures and labels are
    rendered from exact Gaussians, which training does not see.
    """
    size, count = ((320, 256), 30) if full else ((96, 80), 30)
    camera = Camera.from_focal(1.1 * size[0], *size)
    frames, truth = [], []
    for seq in range(count):
        scene, classes = _scene_at(seq / 15)
        one_hot = torch.nn.functional.one_hot(classes, 3).float()
        picture, surface = render(scene, camera), render_surface(replace(scene, extra={"semantics": one_hot}), camera)
        labels = surface.semantics.argmax(-1).to(torch.uint8).numpy()
        truth.append(labels)
        image = (picture.image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        depth = surface.ray_depth.numpy()
        frames.append(Frame(seq, seq * 10**9 // 15, image, depth=depth, labels=labels if seq % 10 == 0 else None))
    config = replace(ReconstructorConfig.offline(), losses=("semantics",), gaussians=20_000 if full else 3_000)
    reconstructor = Reconstructor(config, camera, seed=0, device=device)
    reconstructor.fit(frames, 3000 if full else 300)
    model = reconstructor.snapshot()
    overlaps: dict[str, list[float]] = {name: [] for name in CLASSES}
    for frame, wanted in zip(frames, truth, strict=True):
        if frame.labels is not None:
            continue
        shown = model.surface(frame.time_s).semantics.argmax(-1).cpu().numpy()
        for number, name in enumerate(CLASSES):
            union = ((shown == number) | (wanted == number)).sum()
            overlaps[name].append(float(((shown == number) & (wanted == number)).sum() / max(union, 1)))
    figures = {f"semantics: IoU of {name}": round(statistics.mean(values), 3) for name, values in overlaps.items()}
    mean = round(statistics.mean(figures.values()), 3)
    return {
        "semantics: frames": f"{size[0]}x{size[1]}, {count} frames, labels on 1 in 10",
        **figures,
        "semantics: mean IoU": mean,
    }


def _scene_at(time_s: float) -> tuple[Gaussians, torch.Tensor]:
    """Return exact Gaussians at a time and the class of each, as an index of `CLASSES`."""
    random = torch.Generator().manual_seed(0)
    parts = []
    for number, (across, down, step) in enumerate(((22, 18, 1.0), (3, 30, 0.8), (60, 50, 2.0))):
        a, b = torch.meshgrid(torch.arange(-across, across, step), torch.arange(-down, down, step), indexing="xy")
        a, b = a.ravel(), b.ravel()
        if number == 0:
            rise = 4 * math.sin(math.pi * time_s)
            means = torch.stack([a, b, 60 - (6 + rise) * torch.exp(-(a * a + b * b) / 150)], 1)
        elif number == 1:
            means = torch.stack([a + 0.4 * b - 6 + 6 * time_s, b - 14, 48 + 0 * a], 1)
        else:
            means = torch.stack([a, b, 85 + 0 * a], 1)
        base = torch.tensor([[0.75, 0.3, 0.28], [0.55, 0.57, 0.6], [0.45, 0.25, 0.1]])[number]
        colours = base + 0.12 * torch.randn(len(a), 3, generator=random)
        scales = torch.tensor([0.7 * step, 0.7 * step, 0.1]).log().repeat(len(a), 1)
        quats = torch.tensor([1.0, 0, 0, 0]).repeat(len(a), 1)
        sh = (colours[:, None] - 0.5) / 0.28209479177387814
        parts.append((Gaussians(means, quats, scales, torch.full((len(a),), 4.0), sh), torch.full((len(a),), number)))
    scene = parts[0][0].append(parts[1][0]).append(parts[2][0])
    return scene, torch.cat([classes for _, classes in parts])


def main() -> None:
    parser = log.options(__doc__ or "")
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument(
        "--steps", type=int, default=0, help="of the stereo reconstruction; 0 for 400, or 3000 with --full"
    )
    parser.add_argument("--losses", nargs="*", help="losses of a further stereo reconstruction, comma-separated")
    chosen = parser.parse_args()
    figures: dict[str, Any] = {}
    parts = chosen.parts or PARTS
    if "wall" in parts:
        figures |= wall(chosen.device)
    if "step" in parts:
        figures |= step(chosen.device, chosen.full)
    if "stereo" in parts:
        choices: dict[str, tuple[str, ...]] = {"today": ()}
        for each in chosen.losses or [",".join(TRAINED)]:
            choices[each] = tuple(each.split(","))
        figures |= stereo(
            chosen.device, chosen.full, choices, chosen.seeds, chosen.steps or (3000 if chosen.full else 400)
        )
    if "semantics" in parts:
        figures |= semantics(chosen.device, chosen.full)
    log.write("surface", chosen, figures)


if __name__ == "__main__":
    main()
