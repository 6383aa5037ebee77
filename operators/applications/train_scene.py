"""Training of a static scene in COLMAP's format, with its evaluation on held-out images."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter

import torch

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.ply import save_ply
from gsplat_core.io.recordings.colmap import HELD_OUT_EVERY, read_colmap
from gsplat_core.memory import peak_bytes
from gsplat_core.models.model import Model
from gsplat_core.training.static import FULL_STEPS, StaticConfig, StaticTrainer, read_pictures, read_points
from operators.applications.device import check_device, seeded
from operators.applications.evaluate_scene import SceneScore, SceneSettings, evaluate_scene
from operators.applications.limits import check_picture
from operators.applications.progress import Progress, ProgressCallback
from operators.settings import check_option
from operators.storage import storage_errors, write_whole

RESULT_FILE = "training.json"
MODEL_FOLDER = "model"
PLY_FILE = "scene.ply"
REPORT_EVERY = 100
"""Interval in steps of progress reports with the PSNR of a training picture."""
MOST_STEPS = 10**7


@dataclass(frozen=True)
class TrainSettings:
    """Settings of the training of a static scene.

    Raises:
        InvalidSetting: if a value is out of range.
    """

    scene: Path
    """Folder of the scene."""
    images: str = "images"
    """Folder of the images inside the scene."""
    every: int = HELD_OUT_EVERY
    """The images 0, k, 2k, … in the order of their names are held out; 0 trains on all images."""
    scale: float = 1.0
    """Factor on the size of the images."""
    device: str = "cpu"
    steps: int = FULL_STEPS
    save_every: int = 5000
    """Interval in steps at which the model is saved."""
    strategy: str = "adc"
    """Rule that adds and removes Gaussians: a key of `STARTS`."""
    max_gaussians: int = 1_000_000
    absgrad: bool = False
    sh_degree: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        check_option("scale", self.scale)
        if self.steps > MOST_STEPS:
            raise InvalidSetting(f"steps is {self.steps}; it must be 1 to {MOST_STEPS}")
        _ = self.config
        if self.every < 0 or self.every == 1:
            raise InvalidSetting(f"every is {self.every}; it must be 0 (hold out no image) or at least 2")
        if self.save_every < 1:
            raise InvalidSetting(f"save_every is {self.save_every}; it must be at least 1")
        if not 0 <= self.seed < 2**63:
            raise InvalidSetting(f"seed is {self.seed}; it must be 0 to 2**63 - 1")
        if Path(self.images).is_absolute() or ".." in Path(self.images).parts:
            raise InvalidSetting(f"images is {self.images!r:.80}; give a folder inside the scene")

    @property
    def config(self) -> StaticConfig:
        """These settings as options of the trainer."""
        return StaticConfig(self.steps, self.strategy, self.max_gaussians, self.absgrad, self.sh_degree)


@dataclass(frozen=True)
class SceneTraining:
    """Result of the training of a static scene."""

    steps: int
    """Steps taken; fewer than requested if interrupted."""
    training_images: int
    initial_gaussians: int
    gaussians: int
    training_s: float
    """Duration of the steps in seconds, without reading, saving and evaluation."""
    peak_memory_bytes: int
    """Peak resident memory of the process."""
    device_peak_bytes: int | None
    """Peak memory of tensors on the GPU; None on the CPU."""
    interrupted: bool
    heldout: SceneScore | None
    """Scores of the held-out images; None if there are none or the training was interrupted."""


def train_scene(
    settings: TrainSettings,
    folder: Path,
    *,
    progress: ProgressCallback | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> SceneTraining:
    """Train a scene, save it and evaluate it on its held-out images.

    Writes the bundle `model/`, `scene.ply` and `training.json`. The model is also saved during training.

    Args:
        settings: scene and options.
        folder: where to write.
        progress: called after each picture that is read, every `REPORT_EVERY` steps, before each save, after the last
            step, and after each evaluated image.
        stop_requested: polled after each step; True ends the training with the steps done so far.

    Raises:
        RecordingError: the scene has no cameras or points, or an image is missing or damaged.
        InvalidSetting: an option is out of range.
        StorageFull: the disk is full.
    """
    check_device(settings.device)
    cuda = settings.device == "cuda"
    report = progress or (lambda _: None)
    scene = read_colmap(settings.scene)
    points = read_points(scene)
    posed = scene.training(settings.every) if settings.every else scene.images
    if not posed:
        raise InvalidSetting(f"{settings.scene} has one image, which is held out; give --every 0 to train on it")
    pictures = read_pictures(
        scene, posed, settings.images, settings.scale, lambda done: report(Progress("read", done, len(posed), "images"))
    )
    for picture in pictures:
        check_picture(picture.camera, settings.scale)
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    with seeded(settings.seed, settings.device):
        trainer = StaticTrainer(pictures, points, settings.config, seed=settings.seed, device=settings.device)
        initial = trainer.count
        training_s = _train(trainer, settings, folder, report, stop_requested)
    interrupted = trainer.steps_done < settings.steps
    _save(trainer, folder)
    heldout = None
    if settings.every and not interrupted:
        evaluation = SceneSettings(
            settings.scene, settings.images, settings.every, settings.scale, device=settings.device
        )
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
    written = {**asdict(settings), "scene": settings.scene.name, **asdict(result)}
    write_whole(folder / RESULT_FILE, json.dumps(written, indent=1).encode())
    return result


def _train(
    trainer: StaticTrainer,
    settings: TrainSettings,
    folder: Path,
    report: ProgressCallback,
    stop_requested: Callable[[], bool],
) -> float:
    """Take the steps of a training and return their duration in seconds."""
    total_s, started_s = 0.0, perf_counter()
    for done in range(1, settings.steps + 1):
        step = trainer.step()
        saves = done % settings.save_every == 0 and done < settings.steps
        if done % REPORT_EVERY == 0 or done == settings.steps or saves:
            quality = trainer.psnr_db(step.picture)  # waits for the device
            total_s += perf_counter() - started_s
            report(Progress("train", done, settings.steps, "steps", quality))
            if saves:
                _save(trainer, folder)
            started_s = perf_counter()
        if stop_requested():
            break
    return total_s + perf_counter() - started_s


def _save(trainer: StaticTrainer, folder: Path) -> None:
    """Write the bundle and the `.ply` file of the current state."""
    gaussians = trainer.gaussians()
    with storage_errors(folder):
        save_bundle(Model(1, gaussians, None, trainer.first_camera, (0.0, 0.0)), folder / MODEL_FOLDER)
        save_ply(gaussians, folder / PLY_FILE)
