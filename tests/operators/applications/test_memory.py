"""Nothing that is kept per frame grows with the stream: the same replay, four times as long, holds the same memory."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.reconstructor import ObserveReport
from operators.applications.finishing import FirstFrames, measures_baselines, saves_model
from operators.applications.replay import ReplayApplication, ReplaySettings
from operators.applications.session import Session
from operators.graph import Operator
from operators.metrics import QualityResult, ScoredFrame
from operators.sinks.registry import SINKS
from operators.sources.source import SourceDescription
from operators.sources.threaded import ThreadedSource

WIDTH, HEIGHT = 64, 48
SHORT, LONG = 30, 120
NOISE_BYTES = 10_000
"""For 90 frames more: less than one small dict each, and a fifth of what one frame and its picture take."""


class Moving(ThreadedSource):
    """A pattern that moves, with every field that a frame can have."""

    def __init__(self, count):
        super().__init__()
        camera = Camera.from_focal(60.0, WIDTH, HEIGHT)
        self.description = SourceDescription(
            "moving", WIDTH, HEIGHT, 25.0, camera, frame_count=count, digest="0" * 64, fields=frozenset({"depth"})
        )

    def frames(self):
        x, y = np.arange(WIDTH)[None, :, None], np.arange(HEIGHT)[:, None, None]
        for k in range(self.description.frame_count):
            image = ((x + k) * (y + 3) * (1 + np.arange(3)) % 251).astype(np.uint8)
            depth, mask = np.full((HEIGHT, WIDTH), 50, np.float32), np.ones((HEIGHT, WIDTH), np.uint8)
            yield Frame(k, k * 40_000_000, image, right_image=image.copy(), depth=depth, mask=mask)


class Untrained:
    """A reconstructor that publishes a new version of one model for each frame."""

    def __init__(self, source):
        (first,) = FirstFrames(source, 1)
        self.camera, self.version = source.description.camera, 0
        self.gaussians = gaussians_from_frame(first, self.camera, 50, sh_degree=0, default_depth_mm=50.0)

    def observe(self, frame, **options):
        return ObserveReport(frame.seq, 0, None, self.gaussians.count)

    def publish(self):
        self.version += 1
        return Model(self.version, self.gaussians, None, self.camera, (0.0, 1.0))


def held_bytes(frames, out, sinks=("video", "keyframes")):
    """What Python and NumPy hold when the last frame is reported."""
    source = Moving(frames)
    settings = ReplaySettings(out, out, sinks=sinks)
    untrained = Untrained(source)
    held = []

    def at_the_last_frame(progress):
        if progress.done == frames:
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])

    graph = ReplayApplication(source, settings, progress=at_the_last_frame, make_reconstructor=lambda: untrained)
    finish = [saves_model(out), measures_baselines(source)]
    session = Session(graph, settings.stated(online=True), command="replay", finish=finish)
    gc.collect()
    tracemalloc.start()
    try:
        outcome = session.execute()
    finally:
        tracemalloc.stop()
    assert outcome.find(QualityResult).frames == frames
    return held[0]


@pytest.fixture
def warm(tmp_path):
    """What is made once per process has been made."""
    held_bytes(3, tmp_path)


def test_a_longer_stream_holds_no_more_memory(warm, tmp_path):
    short, long = (held_bytes(frames, tmp_path) for frames in (SHORT, LONG))
    assert long - short < NOISE_BYTES


class HoardOp(Operator):
    """Keeps one number of each frame in a small dict."""

    def setup(self, spec):
        spec.input("scored", type=ScoredFrame)

    def start(self):
        self.kept = []

    def compute(self, op_input, op_output, context):
        self.kept.append({"ssim": op_input.receive("scored").quality.ssim})


def test_the_measurement_sees_a_small_dict_per_frame(warm, tmp_path):
    SINKS.add("hoard", lambda fragment, name, options: HoardOp(fragment, name=name))
    try:
        short, long = (held_bytes(frames, tmp_path, ("hoard",)) for frames in (SHORT, LONG))
    finally:
        SINKS.remove("hoard")
    assert long - short > NOISE_BYTES
