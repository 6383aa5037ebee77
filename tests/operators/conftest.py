"""Operators without a scheduler: fake inputs and outputs, small frames and models."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.initialisation import gaussians_from_frame
from operators.messages import RenderedFrame

WIDTH, HEIGHT = 24, 16


@dataclass
class FakeInput:
    """Input port with prepared messages by name."""

    messages: dict[str, Any]

    def receive(self, name: str) -> Any:
        return self.messages.pop(name, None)

    def queued(self, name: str) -> int:
        return int(name in self.messages)


class QueuedInput:
    """Inputs with queues, by name."""

    def __init__(self, **queues: Any) -> None:
        self.queues = {name: list(messages) for name, messages in queues.items()}

    def receive(self, name: str) -> Any:
        queue = self.queues.get(name)
        return queue.pop(0) if queue else None

    def queued(self, name: str) -> int:
        return len(self.queues.get(name, []))


def run_queued(operator: Any, **queues: Any) -> list[Any]:
    """Run one compute with these queues of messages at the inputs and return the emitted messages."""
    output = FakeOutput()
    operator.compute(QueuedInput(**queues), output, None)
    return [value for _, value in output.emitted]


@pytest.fixture
def compute_queued() -> Callable[..., list[Any]]:
    return run_queued


class FakeTime:
    """Monotonic clock that only the test advances."""

    def __init__(self) -> None:
        self.ns = 1_000_000_000

    def __call__(self) -> int:
        return self.ns

    def pass_ms(self, ms: float) -> None:
        self.ns += round(ms * 1e6)


@pytest.fixture
def fake_time() -> FakeTime:
    return FakeTime()


@dataclass
class FakeOutput:
    """Output port that keeps emitted messages."""

    emitted: list[tuple[str, Any]] = field(default_factory=list)

    def emit(self, value: Any, name: str) -> None:
        self.emitted.append((name, value))


def run_once(operator: Any, **messages: Any) -> list[Any]:
    """Run one compute with these messages and return the emitted ones without port names."""
    output = FakeOutput()
    operator.compute(FakeInput(messages), output, None)
    assert {name for name, _ in output.emitted} <= set(operator.spec.outputs)
    return [value for _, value in output.emitted]


@pytest.fixture
def compute() -> Callable[..., list[Any]]:
    return run_once


def picture(index: int) -> np.ndarray:
    """A smooth picture that moves with the index."""
    x = np.linspace(0, 3, WIDTH)[None, :] + 0.15 * index
    y = np.linspace(0, 2, HEIGHT)[:, None]
    planes = np.stack([np.sin(x + y), np.cos(x - y), np.sin(2 * x) * np.cos(y)], -1)
    return ((planes + 1) * 95 + 10).astype(np.uint8)


def make_frame(index: int = 0, **fields: Any) -> Frame:
    return Frame(**{"seq": index, "pts_ns": index * 40_000_000, "image": picture(index), **fields})


@pytest.fixture
def frame() -> Callable[..., Frame]:
    return make_frame


@pytest.fixture
def camera() -> Camera:
    return Camera.from_focal(30.0, WIDTH, HEIGHT)


def make_rendered(index: int = 0, offset: int = 2, **fields: Any) -> RenderedFrame:
    """A reconstruction that is `offset` grey levels brighter than its frame."""
    source = fields.pop("frame", None) or make_frame(index)
    values = {
        "frame": source,
        "image": source.image + np.uint8(offset),
        "depth": np.full(source.image.shape[:2], 50, np.float32),
        "alpha": np.ones(source.image.shape[:2], np.float32),
        "model_version": index + 1,
        "trained": True,
    }
    return RenderedFrame(**{**values, **fields})


@pytest.fixture
def rendered() -> Callable[..., RenderedFrame]:
    return make_rendered


@pytest.fixture
def model(camera: Camera) -> Callable[..., Model]:
    def make(version: int = 1, index: int = 0) -> Model:
        gaussians = gaussians_from_frame(make_frame(index), camera, 60, sh_degree=0, default_depth_mm=50.0)
        return Model(version, gaussians, None, camera, (0.0, 1.0))

    return make


@dataclass
class FakeRecording:
    """Frames in memory behind the names of a recording."""

    frames: list[Frame]
    camera: Camera
    fps: float = 25.0
    name: str = "fake"
    notes: tuple[str, ...] = ()
    digest: str = "0" * 64
    fields: frozenset[str] = frozenset()
    stereo_baseline_mm: float | None = None
    opened: int = 0

    @property
    def frame_count(self) -> int:
        return len(self.frames)

    @property
    def width_px(self) -> int:
        return self.camera.width_px

    @property
    def height_px(self) -> int:
        return self.camera.height_px

    def camera_at(self, index: int) -> Camera:
        return self.camera

    def __iter__(self) -> Iterator[Frame]:
        self.opened += 1
        return iter(self.frames)


@pytest.fixture
def recording(camera: Camera) -> FakeRecording:
    return FakeRecording([make_frame(k) for k in range(5)], camera)
