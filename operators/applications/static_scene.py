"""Static scenes in COLMAP's format: training, and evaluation of models on held-out images, as trainers of 3DGS do."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.model_sources import load_model
from gsplat_core.io.ply import save_ply
from gsplat_core.io.recordings.colmap import HELD_OUT_EVERY, read_colmap
from gsplat_core.machine import peak_bytes
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import Renderer, RendererOptions, check_renderer, new_renderer
from gsplat_core.training.metrics import frame_quality
from gsplat_core.training.static import StaticConfig, StaticTrainer, read_pictures, read_points
from operators.applications.limits import check_picture, render_bytes, require_memory
from operators.applications.session import Progress, ProgressCallback, check_device, seeded
from operators.rasterize import displayed
from operators.settings import TrainOptions, check_images_folder, check_option
from operators.sinks.video import write_png
from operators.storage import storage_errors, write_whole

EVALUATION_FILE = "evaluation.json"


@dataclass(frozen=True)
class SceneSettings:
    """Settings of an evaluation on a scene.

    Raises:
        InvalidSetting: if a value is out of range.
    """

    scene: Path
    """Folder of the scene."""
    images: str = "images"
    """Folder of the images inside the scene, such as `images_4` for smaller ones."""
    every: int = HELD_OUT_EVERY
    """Interval k of held-out images: those numbered 0, k, 2k, … in the order of their names."""
    scale: float = 1.0
    """Factor on the size of the images."""
    device: str = "cpu"
    renderer: str = "alpha"
    options: RendererOptions = field(default_factory=RendererOptions)

    def __post_init__(self) -> None:
        check_option("scale", self.scale)
        if self.every < 1:
            raise InvalidSetting(f"every is {self.every}; it must be at least 1")
        check_images_folder(self.images)


@dataclass(frozen=True)
class ImageScore:
    """PSNR and SSIM of one held-out image."""

    name: str
    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class SceneScore:
    """Scores of all held-out images; the means are over images, of PSNR in decibels."""

    psnr_db: float
    ssim: float
    worst_db: float
    worst: str
    """Name of the image with the lowest PSNR."""
    gaussians: int
    renderer: str
    images: tuple[ImageScore, ...]


def evaluate_scene(
    source: Path,
    settings: SceneSettings,
    folder: Path | None = None,
    *,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> SceneScore:
    """Render the held-out images of a scene and compare them.

    Args:
        source: bundle or splat file, in the coordinates of the scene. A deforming model is shown at its end.
        settings: scene and renderer.
        folder: where to write `evaluation.json` and the rendered pictures; None for nothing.
        progress: called after each image.
        stop_requested: polled; True ends the evaluation after the current image.

    Raises:
        BundleError: the model cannot be read.
        RecordingError: the scene or an image cannot be read.
        InvalidSetting: an option is out of range, or no image was scored.
        OutputError: `folder` cannot be written.
    """
    check_device(settings.device)
    check_renderer(settings.renderer, settings.device, options=settings.options)
    scene = read_colmap(settings.scene)
    held_out = scene.held_out(settings.every)
    model = load_model(source).to(settings.device)
    renderers: dict[tuple[int, int], Renderer] = {}
    scores: list[ImageScore] = []
    for posed in held_out:
        if stop_requested():
            break
        camera, image = scene.read(posed, settings.images, settings.scale)
        size_px = camera.width_px, camera.height_px
        if size_px not in renderers:
            check_picture(camera, settings.scale)
            if settings.device == "cpu":
                needed = render_bytes(*size_px, model.parameter_count)
                require_memory(needed, f"a picture of {size_px[0]}x{size_px[1]} px", "give a smaller --scale")
            renderers[size_px] = new_renderer(settings.renderer, camera, settings.device, options=settings.options)
            renderers[size_px].prepare(model)
        with torch.inference_mode():
            picture = renderers[size_px].render(camera, model.time_window_s[1], ("image",)).result().image
            quality = frame_quality(len(scores), picture.clamp(0, 1), image)
            if folder is not None:
                write_png(folder / f"{len(scores):04d}.png", displayed(picture))
        scores.append(ImageScore(posed.name, quality.psnr_tissue_db, quality.ssim))
        if progress is not None:
            progress(Progress("evaluate", len(scores), len(held_out)))
    if not scores:
        raise InvalidSetting("the evaluation was interrupted before its first image; there is nothing to report")
    worst = min(scores, key=lambda each: each.psnr_db)
    result = SceneScore(
        psnr_db=float(np.mean([each.psnr_db for each in scores])),
        ssim=float(np.mean([each.ssim for each in scores])),
        worst_db=worst.psnr_db,
        worst=worst.name,
        gaussians=model.gaussians.count,
        renderer=settings.renderer,
        images=tuple(scores),
    )
    if folder is not None:
        write_whole(folder / EVALUATION_FILE, json.dumps(asdict(result), indent=1).encode())
    return result


TRAINING_FILE = "training.json"
MODEL_FOLDER = "model"
PLY_FILE = "scene.ply"
REPORT_EVERY = 100
"""Number of optimiser steps between two progress reports with the PSNR of a training picture."""


@dataclass(frozen=True)
class SceneTraining:
    """Result of the training of a static scene."""

    steps: int
    """Number of optimiser steps taken; fewer than requested if interrupted."""
    training_images: int
    initial_gaussians: int
    gaussians: int
    training_s: float
    """Duration of the optimiser steps in seconds, without reading, saving and evaluation."""
    peak_memory_bytes: int
    """Peak resident memory of the process."""
    device_peak_bytes: int | None
    """Peak memory of tensors on the GPU; None on the CPU."""
    interrupted: bool
    heldout: SceneScore | None
    """Scores of the held-out images; None if there are none or the training was interrupted."""


def train_scene(
    scene: Path,
    options: TrainOptions,
    folder: Path,
    *,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> SceneTraining:
    """Train a scene, save it and evaluate it on its held-out images.

    Writes the bundle `model/`, `scene.ply` and `training.json`. The model is also saved during training.

    Args:
        scene: folder of the scene.
        options: options of the training.
        folder: where to write.
        progress: called after each picture that is read, every `REPORT_EVERY` steps, before each save, after the last
            step, and after each evaluated image.
        stop_requested: polled after each step; True ends the training with the steps done so far.

    Raises:
        RecordingError: the scene has no cameras or points, or an image is missing or damaged.
        InvalidSetting: an option is out of range.
        OutputError: a file cannot be written, for example because the disk is full.
    """
    check_device(options.device)
    cuda = options.device == "cuda"
    report = progress or (lambda _: None)
    posed = read_colmap(scene)
    points = read_points(posed)
    images = posed.training(options.every) if options.every else posed.images
    if not images:
        raise InvalidSetting(f"{scene} has one image, which is held out; give --every 0 to train on it")
    pictures = read_pictures(
        posed, images, options.images, options.scale, lambda done: report(Progress("read", done, len(images), "images"))
    )
    for picture in pictures:
        check_picture(picture.camera, options.scale)
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    with seeded(options.seed, options.device):
        trainer = StaticTrainer(
            pictures, points, options.applied_to(StaticConfig()), seed=options.seed, device=options.device
        )
        initial = trainer.count
        training_s = _train(trainer, options, folder, report, stop_requested)
    interrupted = trainer.steps_done < options.steps
    _save(trainer, folder)
    heldout = None
    if options.every and not interrupted:
        evaluation = SceneSettings(scene, options.images, options.every, options.scale, device=options.device)
        heldout = evaluate_scene(folder / MODEL_FOLDER, evaluation, progress=progress, stop_requested=stop_requested)
    result = SceneTraining(
        steps=trainer.steps_done,
        training_images=len(pictures),
        initial_gaussians=initial,
        gaussians=trainer.count,
        training_s=training_s,
        peak_memory_bytes=peak_bytes(),
        device_peak_bytes=torch.cuda.max_memory_allocated() if cuda else None,
        interrupted=interrupted,
        heldout=heldout,
    )
    written = {"scene": scene.name, **options.options(), **asdict(result)}
    write_whole(folder / TRAINING_FILE, json.dumps(written, indent=1).encode())
    return result


def _train(
    trainer: StaticTrainer,
    options: TrainOptions,
    folder: Path,
    report: ProgressCallback,
    stop_requested: Callable[[], bool],
) -> float:
    """Take the optimiser steps of a training and return their duration in seconds."""
    total_s, started_s = 0.0, perf_counter()
    for done in range(1, options.steps + 1):
        step = trainer.step()
        saves = done % options.save_every == 0 and done < options.steps
        if done % REPORT_EVERY == 0 or done == options.steps or saves:
            quality = trainer.psnr_db(step.picture)  # waits for the device
            total_s += perf_counter() - started_s
            report(Progress("train", done, options.steps, "steps", quality))
            if saves:
                _save(trainer, folder)
            started_s = perf_counter()
        if stop_requested():
            break
    return total_s + perf_counter() - started_s


def _save(trainer: StaticTrainer, folder: Path) -> None:
    gaussians = trainer.gaussians()
    with storage_errors(folder):
        save_bundle(Model(1, gaussians, None, trainer.first_camera, (0.0, 0.0)), folder / MODEL_FOLDER)
        save_ply(gaussians, folder / PLY_FILE)
