"""Evaluation of a model on the held-out images of a scene in COLMAP's format, as trainers of 3DGS do."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.model_sources import load_model
from gsplat_core.io.recordings.colmap import HELD_OUT_EVERY, read_colmap
from gsplat_core.rendering.renderer import Renderer, RendererOptions, check_renderer, new_renderer
from gsplat_core.training.metrics import frame_quality
from operators.applications.device import check_device
from operators.applications.limits import check_picture, render_bytes, require_memory
from operators.applications.progress import Progress, ProgressCallback
from operators.rasterize import displayed
from operators.settings import check_option
from operators.sinks.images import write_png
from operators.storage import write_whole

RESULT_FILE = "evaluation.json"


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
    """The images 0, k, 2k, … in the order of their names are held out."""
    scale: float = 1.0
    """Factor on the size of the images."""
    device: str = "cpu"
    renderer: str = "alpha"
    options: RendererOptions = field(default_factory=RendererOptions)

    def __post_init__(self) -> None:
        check_option("scale", self.scale)
        if self.every < 1:
            raise InvalidSetting(f"every is {self.every}; it must be at least 1")
        if Path(self.images).is_absolute() or ".." in Path(self.images).parts:
            raise InvalidSetting(f"images is {self.images!r:.80}; give a folder inside the scene")


@dataclass(frozen=True)
class ImageScore:
    """Scores of one held-out image."""

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
        write_whole(folder / RESULT_FILE, json.dumps(asdict(result), indent=1).encode())
    return result
