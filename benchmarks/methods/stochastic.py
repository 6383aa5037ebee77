"""Stochastic transparency and Gaussian points: statistics, and frame time and memory next to alpha blending.

    python benchmarks/methods/stochastic.py [--out FILE]                              # statistics and small scenes, CPU
    python benchmarks/methods/stochastic.py --full --device cuda [--millions 1 10 50 106] [--out FILE]
    python benchmarks/methods/stochastic.py --bundle DIR --recording DIR [--scale 0.5] [--frames 5] [--out FILE]

Statistics: z test of the mean of 4,096 samples against the expectation in float64, chi-square test of the Poisson draws, growth of
the PSNR per doubling of the samples, PSNR of the expected point picture to alpha blending, and PSNR of quantised splats. Speed:
random scenes of degree 3, generated on the device, at 1920x1080 (320x180 on the CPU). Each time is the median of the repetitions.
`peak_share` is peak memory less parameters, frame buffer and queue, as a share of the parameters.
"""

from __future__ import annotations

import gc
import importlib
import math
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import log
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording
from gsplat_core.models import Model, TrainedBy
from gsplat_core.ops.stochastic import QUEUE_BYTES, Method, SplatScene, new_sums, picture_of, sample_splats
from gsplat_core.reference.rendering import point_moments, sample_moments
from gsplat_core.rendering.rasterization import render
from gsplat_core.rendering.renderer import RendererOptions, new_renderer
from gsplat_core.rendering.stochastic import dequantised, prepared_splats, quantised_splats, raw_splats
from gsplat_core.rendering.weighted_sum import WeightedSumRenderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

METHODS: tuple[Method, ...] = ("fragments", "points")
TARGET_DB = 35.0


def psnr(a: Tensor, b: Tensor) -> float:
    """Return the PSNR of two images with a range of 1, in dB."""
    return -10 * math.log10(max(float((a - b).double().square().mean()), 1e-15))


def cloud(count: int, device: str, seed: int = 0, largest_share: float = 1.0) -> Gaussians:
    """Return `count` Gaussians of degree 3 in a box of 8 x 6 x 8 units, of which a camera at the origin sees the greater part.

    The mean standard deviation shrinks with the cube root of the count, as the spacing does.
    """
    g = torch.Generator(device).manual_seed(seed)
    means = torch.empty(count, 3, device=device).uniform_(-1, 1, generator=g)
    means.mul_(torch.tensor([4.0, 3.0, 4.0], device=device)).add_(torch.tensor([0, 0, 7.0], device=device))
    quats = torch.empty(count, 4, device=device).normal_(generator=g)
    log_scales = torch.empty(count, 3, device=device).normal_(
        math.log(1.2 * largest_share * count ** (-1 / 3)), 0.5, generator=g
    )
    logits = torch.empty(count, device=device).normal_(0, 2, generator=g)
    sh = torch.empty(count, 16, 3, device=device).normal_(0, 0.15, generator=g)
    return Gaussians(means, quats, log_scales, logits, sh)


def size_of(scene: SplatScene) -> int:
    """Return the bytes of a scene's tensors."""
    return sum(t.numel() * t.element_size() for t in scene.tensors())


def milliseconds(work: Callable[[], object], device: str, repetitions: int) -> float:
    """Return the median time of `work` in ms, after two warm-up calls."""
    times = []
    for number in range(repetitions + 2):
        if device == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        if number >= 2:
            times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)


# ---- Statistics ---------------------------------------------------------------------------------------------------------


def sampled(
    scene: SplatScene, camera: Camera, method: Method, samples: int, supersampling: int = 1, **options: Any
) -> Tensor:
    """Return the sums of a picture."""
    sums = new_sums(camera, scene.tensors()[0].device)
    sample_splats(scene, camera, sums, method=method, samples=samples, supersampling=supersampling, **options)
    return sums


def statistic_scene() -> tuple[Gaussians, Camera]:
    """Return 150 Gaussians with standard deviations from 0.6 to 5 px and a camera of 96x72 px."""
    g = torch.Generator().manual_seed(0)
    count = 150
    means = torch.randn(count, 3, generator=g) * torch.tensor([1.0, 0.75, 0.5]) + torch.tensor([0, 0, 4.0])
    log_scales = torch.empty(count, 3).uniform_(math.log(0.02), math.log(0.17), generator=g)
    gaussians = Gaussians(
        means,
        torch.randn(count, 4, generator=g),
        log_scales,
        torch.randn(count, generator=g) * 2,
        torch.randn(count, 16, 3, generator=g) * 0.3,
    )
    return gaussians, Camera.from_focal(120, 96, 72)


def statistics_of(device: str, samples: int, seeds: int) -> dict[str, Any]:
    """Return the figures of the statistical tests, over the pixels of pictures with as many seeds."""
    gaussians, camera = statistic_scene()
    exact = gaussians.to(dtype=torch.float64)
    scene = raw_splats(gaussians.to(device))
    figures: dict[str, Any] = {"z_samples": samples, "z_seeds": seeds}
    moments = {"fragments": sample_moments(exact, camera), "points": point_moments(exact, camera)}
    for method in METHODS:
        mean, variance = moments[method]
        sums = torch.stack([sampled(scene, camera, method, samples, seed=seed).cpu().double() for seed in range(seeds)])
        z = (sums / samples - mean) / (variance / samples).sqrt()
        chance = mean[..., 3:4]
        # With fewer expected hits the mean is not normally distributed.
        normal = ((samples * chance > 30) & (samples * (1 - chance) > 30)).expand(z.shape) & (variance > 1e-12)
        z = z[normal]
        figures[f"z_{method}"] = {
            "values": len(z),
            "mean": round(float(z.mean()), 4),
            "variance": round(float(z.var()), 4),
            "share_above_5": float((z.abs() > 5).double().mean()),
        }
        scores = []
        for power in range(11):
            image = sampled(scene, camera, method, 1 << power, seed=1)[..., :3].cpu().double() / (1 << power)
            scores.append(psnr(image, mean[..., :3]))
        figures[f"psnr_by_doubling_{method}"] = [round(s, 2) for s in scores]
        figures[f"db_per_doubling_{method}"] = round((scores[-1] - scores[0]) / 10, 3)
    few, small = exact.select(slice(0, 60)), Camera.from_focal(60, 48, 36)
    fine = {s: point_moments(few, small, s, quadrature=8 // s).mean[..., :3] for s in (1, 4)}
    centre = {s: sample_moments(few, small, s).mean[..., :3] for s in (1, 4)}
    figures["points_to_alpha_at_pixel_centres_db"] = {s: round(psnr(fine[s], centre[1]), 2) for s in (1, 4)}
    figures["points_to_alpha_at_subpixel_centres_db"] = {s: round(psnr(fine[s], centre[s]), 2) for s in (1, 4)}
    figures["poisson_smallest_p"] = round(min(poisson_p_values(device)), 4)
    return figures


def poisson_p_values(device: str) -> list[float]:
    """Return the p-values of a chi-square test for 20 rates from 1e-3 to 1e4."""
    from tests.gsplat_core.ops.stochastic_scenes import RATES
    from tests.gsplat_core.ops.stochastic_scenes import poisson_p_values as p_values

    return p_values(torch.ops.gsplat_core.poisson_draws(RATES.to(device), 100_000, 7))


def quantisation(device: str) -> dict[str, Any]:
    """Return size and quality of quantised random splats, by alpha blending of the decoded ones."""
    gaussians = cloud(200_000, device)
    camera = Camera.from_focal(500, 640, 360)
    scene = quantised_splats(gaussians)
    image = render(gaussians, camera).image
    return {
        "bytes_per_splat": round(size_of(scene) / scene.splat_count, 1),
        "raw_bytes_per_splat": 236,
        "psnr_to_unquantised_db": round(psnr(render(dequantised(scene), camera).image, image), 2),
    }


def on_recording(folder: Path, recording: Path, scale: float, frames: int, device: str) -> dict[str, Any]:
    """Return the PSNR to the last frame of a recording: alpha blending, sampled pictures and quantised splats."""
    model = load_bundle(folder).to(device)
    *_, frame = open_recording(recording, scale=scale, max_frames=frames)
    camera = model.camera
    truth = torch.from_numpy(frame.image.copy()).to(device).float() / 255
    seen = torch.ones(truth.shape[:2], dtype=torch.bool, device=device)
    if frame.mask is not None:
        seen = torch.from_numpy(frame.mask.copy()).to(device) != 0  # tissue
    gaussians = model.at(frame.time_s)
    score = lambda image: round(psnr(image.clamp(0, 1)[seen], truth[seen]), 3)
    alpha = render(gaussians, camera).image
    figures: dict[str, Any] = {"splats": gaussians.count, "alpha_db": score(alpha)}
    scene, quantised = raw_splats(gaussians), quantised_splats(gaussians)
    figures["alpha_of_quantised_db"] = score(render(dequantised(quantised), camera).image)
    for samples in (1, 4, 16, 64, 256):
        image = picture_of(sampled(scene, camera, "fragments", samples), samples).image
        figures[f"stochastic_{samples}"] = {"to_frame_db": score(image), "to_alpha_db": round(psnr(image, alpha), 2)}
    for supersampling in (1, 2, 4):
        image = picture_of(sampled(scene, camera, "points", 16, supersampling), 16 * supersampling**2).image
        figures[f"points_16_x{supersampling}"] = {
            "to_frame_db": score(image),
            "to_alpha_db": round(psnr(image, alpha), 2),
        }
    times = 5 if device == "cpu" else 50
    for samples in (1, 16):
        figures[f"stochastic_{samples}_ms"] = try_ms(
            partial(sampled, scene, camera, "fragments", samples), device, times
        )
    figures["points_1_ms"] = try_ms(partial(sampled, scene, camera, "points", 1), device, times)
    figures["alpha_ms"] = try_ms(partial(render, gaussians, camera), device, times)
    return figures


# ---- Speed and memory -----------------------------------------------------------------------------------------------------


def try_ms(work: Callable[[], object], device: str, repetitions: int) -> float | str:
    """Return the median time in ms, or the reason why there is none."""
    try:
        return round(milliseconds(work, device, repetitions), 3)
    except torch.OutOfMemoryError:
        return "out of memory"
    except (RuntimeError, TypeError, ValueError) as error:  # from another program's renderer
        return f"{type(error).__name__}: {str(error).splitlines()[0][:120]}"
    finally:
        gc.collect()
        if device == "cuda":
            torch.cuda.empty_cache()


def renderer_ms(name: str, model: Model, options: RendererOptions | None, repetitions: int) -> float | str:
    """Return the frame time of a registered renderer."""
    device = model.device.type

    def frames() -> float:
        renderer = new_renderer(name, model.camera, device, options=options)
        renderer.prepare(model)
        return milliseconds(lambda: renderer.render(model.camera, 0.0).result(), device, repetitions)

    try:
        with torch.inference_mode():
            return round(frames(), 3)
    except torch.OutOfMemoryError:
        return "out of memory"
    finally:
        gc.collect()
        if device == "cuda":
            torch.cuda.empty_cache()


def gsplat_ms(gaussians: Gaussians, camera: Camera, device: str, repetitions: int) -> float | str:
    """Return the frame time of gsplat, if it is installed."""
    try:
        rasterization = importlib.import_module("gsplat.rendering").rasterization
    except ImportError:
        return "not installed"
    viewmat, K = camera.matrices(gaussians.device)
    with torch.inference_mode():
        scales, opacities = gaussians.scales, gaussians.opacities
        return try_ms(
            lambda: rasterization(
                gaussians.means, gaussians.quats, scales, opacities, gaussians.sh, viewmat[None], K[None],
                camera.width_px, camera.height_px, sh_degree=3, packed=True,
            ),
            device,
            repetitions,
        )  # fmt: skip


def peak_share(scene: SplatScene, camera: Camera, method: Method, samples: int) -> dict[str, Any]:
    """Return peak device memory of a frame in addition to parameters, frame buffer and queue."""
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    sums = sampled(scene, camera, method, samples)
    torch.cuda.synchronize()
    peak = torch.cuda.max_memory_allocated() - before
    slots = 1 if method == "points" or samples == 1 else 4
    frame = camera.width_px * camera.height_px * 8 * slots
    rest = peak - frame - QUEUE_BYTES - sums.numel() * 4
    return {
        "peak_mb": round((peak + size_of(scene)) / 1e6, 1),
        "parameters_mb": round(size_of(scene) / 1e6, 1),
        "frame_and_sums_mb": round((frame + sums.numel() * 4) / 1e6, 1),
        "peak_share": round(rest / size_of(scene), 5),
    }


def time_to_target(scene: SplatScene, camera: Camera, method: Method, wanted: Tensor, device: str) -> dict[str, Any]:
    """Return samples and time that reach TARGET_DB against alpha blending, from the error of 64 samples."""
    probe = 64 if device == "cuda" else 8
    supersampling = 1 if method == "fragments" else 4 if device == "cuda" else 2
    picture = picture_of(sampled(scene, camera, method, probe, supersampling), probe * supersampling**2).image
    floor = psnr(picture, wanted)
    needed = max(1, math.ceil(probe * 10 ** ((TARGET_DB - floor) / 10)))
    result: dict[str, Any] = {
        "probe_samples": probe,
        "probe_db": round(floor, 2),
        "samples": needed,
        "supersampling": supersampling,
    }
    if needed > (4096 if device == "cuda" else 64):
        return result
    picture = picture_of(sampled(scene, camera, method, needed, supersampling), needed * supersampling**2).image
    result["db"] = round(psnr(picture, wanted), 2)
    result["ms"] = try_ms(lambda: sampled(scene, camera, method, needed, supersampling), device, 3)
    return result


def speed(count: int, camera: Camera, device: str, repetitions: int) -> dict[str, Any]:
    """Return frame times and memory of all renderers for a scene of `count` splats."""
    gaussians = cloud(count, device)
    scene = raw_splats(gaussians)
    model = Model(1, gaussians, None, camera, (0.0, 1.0))
    row: dict[str, Any] = {"splats": count}
    if device == "cuda":
        row["memory_stochastic_1"] = peak_share(scene, camera, "fragments", 1)
        row["memory_points_1"] = peak_share(scene, camera, "points", 1)
    for samples in (1, 4, 16):
        options = RendererOptions(samples=samples)
        row[f"stochastic_{samples}_ms"] = renderer_ms("stochastic", model, options, repetitions)
    row["stochastic_1_order_pixel_ms"] = renderer_ms(
        "stochastic", model, RendererOptions(samples=1, order="pixel"), repetitions
    )
    row["points_1_ms"] = renderer_ms("points", model, RendererOptions(samples=1), repetitions)
    row["points_4_ms"] = renderer_ms("points", model, RendererOptions(samples=4), repetitions)
    wanted = None
    row["alpha_ms"] = renderer_ms("alpha", model, None, repetitions)
    try:
        with torch.inference_mode():
            wanted = render(gaussians, camera).image.clone()
    except torch.OutOfMemoryError:
        row["alpha_picture"] = "out of memory"
    gc.collect()
    if wanted is not None:
        row["stochastic_to_35_db"] = time_to_target(scene, camera, "fragments", wanted, device)
        row["points_to_35_db"] = time_to_target(scene, camera, "points", wanted, device)
    if "weighted_sum" in RENDERERS:
        try:
            # The model as at the start of its training; the mean distance is 7.
            started = WeightedSumRenderer.extended(gaussians)
            by = TrainedBy("weighted_sum", WeightedSumRenderer.first_values(7.0))
            own = Model(1, started, None, camera, (0.0, 1.0), trained_by=by)
            row["weighted_sum_ms"] = renderer_ms("weighted_sum", own, None, repetitions)
            del started, own
        except (InvalidInput, InvalidSetting, torch.OutOfMemoryError) as error:
            row["weighted_sum_ms"] = f"{type(error).__name__}: {str(error).splitlines()[0][:120]}"
    row["gsplat_ms"] = gsplat_ms(gaussians, camera, device, repetitions)
    if count <= 20_000_000:
        for name, make in (("prepared", prepared_splats), ("quantised", quantised_splats)):
            other = make(gaussians)
            row[f"stochastic_1_{name}_ms"] = try_ms(
                partial(sampled, other, camera, "fragments", 1), device, repetitions
            )
            del other
    return row


def huge_against_small(camera: Camera, device: str, repetitions: int) -> dict[str, Any]:
    """Return the times of equal numbers of fragments in few huge and in many small splats of low opacity."""
    scale = camera.width_px / 1920
    figures: dict[str, Any] = {}
    for name, count, sigma_px in (("huge", 24, 150.0), ("small", 24 * 2500, 3.0)):
        g = torch.Generator(device).manual_seed(3)
        z = torch.empty(count, device=device).uniform_(4, 5, generator=g)
        margin = 0.26  # the boxes stay inside the picture
        x, y = (torch.empty(count, device=device).uniform_(-1, 1, generator=g) for _ in range(2))
        means = (
            torch.stack(
                [
                    x * (0.5 - margin) * camera.width_px * z / camera.K[0, 0],
                    y * 0.04 * camera.height_px * z / camera.K[1, 1],
                    z,
                ],
                -1,
            )
            if name == "huge"
            else torch.stack(
                [x * 0.45 * camera.width_px * z / camera.K[0, 0], y * 0.45 * camera.height_px * z / camera.K[1, 1], z],
                -1,
            )
        )
        sizes = (sigma_px * scale * z / camera.K[0, 0]).log()[:, None].repeat(1, 3)
        gaussians = Gaussians(
            means.float(),
            torch.tensor([[1.0, 0, 0, 0]], device=device).repeat(count, 1),
            sizes.float(),
            torch.full((count,), -2.0, device=device),
            torch.zeros(count, 1, 3, device=device),
        )
        figures[f"{name}_ms"] = try_ms(
            partial(sampled, raw_splats(gaussians), camera, "fragments", 1), device, repetitions
        )
        extent = math.sqrt(2 * math.log(255 / (1 + math.exp(2.0))))
        figures[f"{name}_fragments"] = round(count * (2 * extent * sigma_px * scale) ** 2)
    huge, small = figures["huge_ms"], figures["small_ms"]
    if isinstance(huge, float) and isinstance(small, float):
        figures["ratio"] = round(huge / small, 3)
    return figures


def main() -> None:
    """Run the benchmark."""
    parser = log.options(__doc__.splitlines()[0])
    parser.add_argument("--millions", type=float, nargs="+", help="sizes of the scenes; 1, 10, 50 and 106 with --full")
    parser.add_argument("--samples", type=int, default=4096, help="samples of the z test")
    parser.add_argument("--seeds", type=int, default=16, help="pictures of the z test")
    parser.add_argument("--repetitions", type=int, help="frames of each timing")
    parser.add_argument("--bundle", type=Path, help="model of a replay, to score on its recording")
    parser.add_argument("--recording", type=Path, help="recording of the bundle")
    parser.add_argument("--scale", type=float, default=1.0, help="scale of the recording in the replay")
    parser.add_argument("--frames", type=int, default=5, help="frames of the replay")
    chosen = parser.parse_args()
    device = chosen.device
    millions = chosen.millions or ([1, 10, 50, 106] if chosen.full else [0.01, 0.1])
    repetitions = chosen.repetitions or (10 if chosen.full else 2)
    camera = Camera.from_focal(1500, 1920, 1080) if chosen.full else Camera.from_focal(250, 320, 180)
    if chosen.bundle is not None:
        scored = on_recording(chosen.bundle, chosen.recording, chosen.scale, chosen.frames, device)
        log.write("stochastic", chosen, {"recording": chosen.recording.name, **scored})
        return
    figures: dict[str, Any] = {"size_px": [camera.width_px, camera.height_px]}
    figures |= statistics_of(device, chosen.samples, chosen.seeds)
    figures["quantised"] = quantisation(device)
    figures["huge_against_small"] = huge_against_small(camera, device, repetitions)
    for size in millions:
        figures[f"speed_{size:g}M"] = speed(round(size * 1e6), camera, device, repetitions)
        gc.collect()
        log.write("stochastic", chosen, figures)  # after each size, because a larger one may fail


if __name__ == "__main__":
    main()
