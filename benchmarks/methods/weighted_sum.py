"""Measure weighted sum rendering beside alpha blending: quality after equal training, popping, order, and time.

    OMP_NUM_THREADS=2 python benchmarks/methods/weighted_sum.py [--device cuda --full] [--out FILE.json]

Both renderers train on the same frames of a recording with equal steps. Popping is measured on these models: the camera turns
by 0.1 degrees about its centre, the picture is warped by the exact homography of the turn, and the difference to the
picture after the turn is taken. Its 99.9th percentile contains changes of the order of splats and errors of the interpolation.
Pictures with 4x4 samples a pixel, which are warped before the mean over a pixel is taken, have the fewest of these errors.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import log
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from gsplat_core.choices import RENDERERS
from gsplat_core.io.recordings import is_heldout, open_recording
from gsplat_core.models import Model
from gsplat_core.rendering.rasterization import RenderOutput, render
from gsplat_core.rendering.renderer import new_renderer
from gsplat_core.rendering.weighted_sum import WeightedSumRenderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor

VARIANTS = {
    "weighted_sum_direct": "gsplat_core.rendering.weighted_sum:DirectWeightedSumRenderer",
    "weighted_sum_exp": "gsplat_core.rendering.weighted_sum:ExpWeightedSumRenderer",
}
RECORDINGS = Path(
    os.environ.get("INTRASPLAT_RECORDINGS", Path(__file__).resolve().parents[3] / "shared" / "recordings")
)
TURN_DEGREES = 0.1
TURNS = 10
MARGIN_PX = 8
SAMPLES = (1, 2, 4)
"""Samples in a row and column of a pixel of the pictures in which popping is measured."""


def picture(model: Model, camera: Camera, time_s: float) -> np.ndarray:
    """Return the picture of a model by the renderer that trained it, float32 [H, W, 3]."""
    renderer = new_renderer(model.trained_by.renderer, camera, model.device)
    renderer.prepare(model)
    return renderer.render(camera, time_s, ("image",)).result().image.cpu().numpy().astype(np.float32)


def train(renderer: str, frames: list, camera: Camera, config: ReconstructorConfig, steps: int, device: str) -> dict:
    """Train on the frames that are not held out; return model, held-out PSNR in dB, and seconds."""
    learning = Reconstructor(config, camera, device=device)
    start = time.perf_counter()
    learning.fit([frame for frame in frames if not is_heldout(frame.seq)], steps)
    model = learning.snapshot()
    seconds = time.perf_counter() - start
    scores = [
        psnr_tissue_db(
            np.clip(picture(model, camera if frame.pose is None else camera.with_pose(frame.pose), frame.time_s), 0, 1),
            frame.image, frame.mask,
        )
        for frame in frames
        if is_heldout(frame.seq)
    ]  # fmt: skip
    return {
        "model": model,
        "heldout_db": statistics.mean(scores),
        "seconds": seconds,
        "gaussians": model.gaussian_count,
    }


def popping(model: Model, time_s: float, samples: int) -> float:
    """Return the 99.9th percentile of the warped difference, mean of all turns, in grey levels of 255.

    Pictures have samples x samples values for each pixel of the training pictures. They are warped at this size, and the
    difference is averaged over the pixels.
    """
    camera = model.camera.scaled(samples)
    intrinsics = camera.K
    found = []
    before: np.ndarray | None = None
    last_turn: Any = np.eye(3)
    for number in range(TURNS + 1):
        angle = np.radians(TURN_DEGREES * number)
        turn: Any = cv2.Rodrigues(np.array([0.35 * angle, angle, 0.0]))[0]
        pose = np.eye(4)
        pose[:3, :3] = turn
        seen = picture(model, camera.with_pose(pose @ camera.world_to_camera), time_s)
        if before is not None:
            relative = turn @ last_turn.T
            # Pixel centres are at half-integers here and at integers in OpenCV.
            shift = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
            matrix = shift @ intrinsics @ relative @ np.linalg.inv(shift @ intrinsics)
            size = (camera.width_px, camera.height_px)
            warped = cv2.warpPerspective(before, matrix, size, flags=cv2.INTER_LANCZOS4)
            small = model.camera.width_px, model.camera.height_px
            off = np.abs(cv2.resize(warped - seen, small, interpolation=cv2.INTER_AREA))
            inner = off[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].max(-1)
            found.append(float(np.percentile(inner, 99.9)) * 255)
        before, last_turn = seen, turn
    return statistics.mean(found)


def random_scene(count: int, camera: Camera, device: str) -> Gaussians:
    """Return splats in the camera's frustum at depths 40 to 120, a few pixels large."""
    g = torch.Generator(device).manual_seed(0)
    rand = lambda *shape: torch.rand(*shape, generator=g, device=device)
    z = 40 + 80 * rand(count)
    pixels = rand(count, 2) * torch.tensor([camera.width_px, camera.height_px], device=device)
    centre = torch.tensor([camera.K[0, 2], camera.K[1, 2]], device=device, dtype=torch.float32)
    focal = float(camera.K[0, 0])
    means = torch.cat([(pixels - centre) / focal * z[:, None], z[:, None]], 1)
    spacing_px = (camera.width_px * camera.height_px / count) ** 0.5
    scales = (z / focal * max(0.7, 1.5 * spacing_px))[:, None] * (0.5 + rand(count, 3))
    quats = torch.randn(count, 4, generator=g, device=device)
    opacities = torch.logit(0.1 + 0.8 * rand(count))
    return Gaussians(means, quats, scales.log(), opacities, ((rand(count, 1, 3)) - 0.5) / SH_C0)


def milliseconds(run: Callable[[], object], device: str, repeats: int) -> float:
    """Return the median time of a call."""
    times = []
    for _ in range(repeats + 2):
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        start = time.perf_counter()
        run()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times[2:])


def speed(count: int, size: tuple[int, int], device: str, repeats: int) -> dict:
    """Return times of pictures and of forward and backward passes, and the identity of bytes in another order."""
    camera = Camera.from_focal(0.9 * size[0], *size)
    scene = random_scene(count, camera, device)
    extended = WeightedSumRenderer.extended(scene)
    values = {name: torch.tensor(v, device=device) for name, v in WeightedSumRenderer.first_values(80.0).items()}
    show = lambda gaussians: WeightedSumRenderer.picture(gaussians, camera, None, values)
    with torch.no_grad():
        alpha_ms = milliseconds(lambda: render(scene, camera), device, repeats)
        own_ms = milliseconds(lambda: show(extended), device, repeats)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(1)).to(device)
        same = all(torch.equal(a, b) for a, b in zip(show(extended), show(extended.select(order)), strict=True))

    def step(gaussians: Gaussians, draw: Callable[[Gaussians], RenderOutput]) -> None:
        leaves = gaussians.detach().requires_grad_()
        output = draw(leaves)
        (output.image.square().sum() + output.alpha.sum()).backward()

    return {
        "splats": count,
        "size": list(size),
        "alpha_ms": alpha_ms,
        "weighted_sum_ms": own_ms,
        "time_ratio": own_ms / alpha_ms,
        "alpha_forward_backward_ms": milliseconds(
            lambda: step(scene, lambda g: render(g, camera)), device, repeats // 2 + 1
        ),
        "weighted_sum_forward_backward_ms": milliseconds(lambda: step(extended, show), device, repeats // 2 + 1),
        "same_bytes_in_another_order": same,
    }


def main() -> None:
    parser = log.options("Weighted sum rendering beside alpha blending.")
    parser.add_argument("--recording", default=str(RECORDINGS / "cutting"))
    parser.add_argument("--scale", type=float)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--gaussians", type=int)
    parser.add_argument("--variants", action="store_true", help="train the variants direct and exp too")
    parser.add_argument("--ssim", type=float, default=0.0, help="weight of 1 - SSIM for the weighted sums")
    chosen = parser.parse_args()
    scale = chosen.scale or (1.0 if chosen.full else 0.5)
    steps = chosen.steps or (3000 if chosen.full else 300)
    count = chosen.gaussians or (60_000 if chosen.full else 8_000)
    recording = open_recording(chosen.recording, scale=scale, max_frames=chosen.frames or (None if chosen.full else 25))
    frames = list(recording)
    for name, kind in VARIANTS.items():
        RENDERERS.add(name, kind)
    config = ReconstructorConfig.offline()
    base = dict(vars(config), gaussians=count, max_gaussians=count * 4 // 3)
    names = ["alpha", "weighted_sum", *(VARIANTS if chosen.variants else ())]
    figures: dict = {"recording": "cutting", "scale": scale, "frames": len(frames), "steps": steps}
    for name in names:
        loss = {} if name == "alpha" or not chosen.ssim else {"ssim_weight": chosen.ssim, "squared_error": False}
        result = train(
            name,
            frames,
            recording.camera,
            ReconstructorConfig(**{**base, **loss, "renderer": name}),
            steps,
            chosen.device,
        )
        model = result.pop("model")
        middle_s = frames[len(frames) // 2].time_s
        result["popping_grey_levels"] = {f"{n}x": popping(model, middle_s, n) for n in SAMPLES}
        result["values"] = dict(model.trained_by.values)
        figures[name] = result
        print(name, result, flush=True)
    figures["heldout_minus_alpha_db"] = figures["weighted_sum"]["heldout_db"] - figures["alpha"]["heldout_db"]
    figures["popping_ratio"] = {
        size: figures["weighted_sum"]["popping_grey_levels"][size] / value
        for size, value in figures["alpha"]["popping_grey_levels"].items()
    }
    figures["speed"] = (
        [speed(n, (1920, 1080), chosen.device, 20) for n in (100_000, 1_000_000)]
        if chosen.full
        else [speed(20_000, (640, 512), chosen.device, 6)]
    )
    log.write("weighted_sum", chosen, figures)


if __name__ == "__main__":
    main()
