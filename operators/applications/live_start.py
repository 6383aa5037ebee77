"""What is done before a live stream's first frame, so that no frame has to wait for it."""

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
"""Garbage is looked for seldom, and mostly among what is new: no frame makes cycles of objects, and a whole search takes tens of ms."""
SWITCH_INTERVAL_S = 0.0002
"""How long a thread may keep Python's interpreter while another one waits for it: a frame must not wait for 5 ms, the default."""
OPENCV_THREADS = 1
"""More of them take longer to start than small pictures take to look at."""


def new_live_reconstructor(settings: LiveSettings, source: FrameSource) -> LiveReconstructor:
    """A reconstructor for the frames of a source."""
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
    """What a live run works with."""

    reconstructor: LiveReconstructor
    rasterizer: Rasterizer


def new_parts(settings: LiveSettings, source: FrameSource) -> LiveParts:
    """The parts for the frames of a source; their first use takes long."""
    return LiveParts(new_live_reconstructor(settings, source), Rasterizer(settings.renderer))


def warm_up(settings: LiveSettings, source: FrameSource) -> LiveParts:
    """New parts that have done everything once that takes long the first time: graphs are captured, memory is taken, the length of a step is
    known. The stream's first frame then has to wait for none of it."""
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
    """Inside, threads take turns often, and what exists already is never searched for garbage again."""
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
