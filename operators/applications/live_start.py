"""Preparation of a live run before its first frame: warm-up and interpreter settings for low
latency.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import cv2

from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.live import LiveReconstructor
from operators.applications.device import seeded
from operators.applications.live_settings import LiveSettings
from operators.applications.warm_reconstructor import warm_reconstructor
from operators.messages import DeformedScene
from operators.rasterize import Rasterizer
from operators.sources.source import FrameSource

GARBAGE_THRESHOLDS = (20_000, 20, 1000)
"""Thresholds of the garbage collector. Collections are rare and mostly of young objects: processing
a frame creates no cycles, and a full collection takes tens of milliseconds.
"""
SWITCH_INTERVAL_S = 0.0002
"""Interpreter switch interval in seconds. With the default of 5 ms, a thread could wait that long
for the GIL.
"""
OPENCV_THREADS = 1
"""Number of OpenCV threads. Starting more takes longer than processing a small picture."""


def new_live_reconstructor(settings: LiveSettings, source: FrameSource) -> LiveReconstructor:
    """Create a reconstructor for the frames of a source."""
    camera = source.description.camera
    return LiveReconstructor(
        settings.reconstructor_config(camera.width_px * camera.height_px),
        camera,
        live=settings.chosen_training,
        seed=settings.seed,
        device=settings.device,
    )


@dataclass(frozen=True)
class LiveParts:
    """Components of a live session."""

    reconstructor: LiveReconstructor
    rasterizer: Rasterizer


def new_parts(settings: LiveSettings, source: FrameSource) -> LiveParts:
    """Create the components for a source. Their first use is slow (see `warm_up`)."""
    return LiveParts(new_live_reconstructor(settings, source), Rasterizer(settings.renderer))


def warm_up(settings: LiveSettings, source: FrameSource) -> LiveParts:
    """Create the components and exercise them: capture graphs, allocate memory, measure the
    duration of a step.
    """
    camera = source.description.camera
    parts = new_parts(settings, source)

    def draw(frame: Frame, model: Model | Snapshot) -> object:
        scene = DeformedScene(frame, model, camera, trained=True)
        return scene, parts.rasterizer.draw(scene)

    with seeded(settings.seed, settings.device):
        warm_reconstructor(parts.reconstructor, draw, stereo=source.description.is_stereo)
    return parts


@contextmanager
def low_latency() -> Iterator[None]:
    """Context manager with a short interpreter switch interval and existing objects exempt from
    garbage collection.
    """
    interval_s = sys.getswitchinterval()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(min(threads, OPENCV_THREADS))
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    thresholds = gc.get_threshold()
    gc.set_threshold(*GARBAGE_THRESHOLDS)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()
        cv2.setNumThreads(threads)
        sys.setswitchinterval(interval_s)
