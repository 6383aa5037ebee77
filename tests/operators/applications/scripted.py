"""A live stream that is written down frame by frame, and what became of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsplat_core.io.bundle import load_bundle
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from operators.applications.session import RunOutcome
from operators.applications.working_size import made_up_tissue
from operators.messages import PictureState, ShownPicture
from operators.sources.live import LiveSource
from operators.sources.source import SourceDescription
from operators.training import TrainingCounts

WIDTH, HEIGHT, FPS = 64, 48, 25.0
INTERVAL_NS = round(1e9 / FPS)
SECOND_NS = 1_000_000_000
BLACK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def tissue() -> np.ndarray:
    """A large picture whose brightness and redness vary."""
    picture = made_up_tissue(4 * HEIGHT, 8 * WIDTH).astype(np.float32)
    picture[..., 1] *= 0.85 + 0.3 * np.sin(np.arange(8 * WIDTH) / 9)
    return np.clip(picture, 0, 255).astype(np.uint8)


TISSUE = tissue()


@dataclass(frozen=True)
class Scripted:
    """Scripted frame of a stream."""

    frame: Frame
    good: bool
    """True if training may use the frame."""
    pause_s: float = 0.0
    """Time without frames before it."""


def scope_picture(index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Tissue that moves a little from one picture to the next."""
    x = index % 400
    x = min(x, 400 - x)
    y = round(10 + 10 * np.sin(index / 7))
    return np.ascontiguousarray(TISSUE[y : y + height, x : x + width])


def torn(picture: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The picture's upper half above the lower one of the picture before."""
    return np.concatenate([picture[: HEIGHT // 2], before[HEIGHT // 2 :]])


class Script:
    """Builds a stream frame by frame."""

    def __init__(self, **fields: Callable[[int], Any]) -> None:
        """fields: what every frame has besides its picture, by the frame's number."""
        self.frames: list[Scripted] = []
        self.pts_ns = 0
        self._fields = fields

    @property
    def newest(self) -> Frame:
        """The last frame so far."""
        return self.frames[-1].frame

    def good(self, count: int, pause_s: float = 0.0, **fields: Any) -> range:
        """Add so many ordinary frames; their numbers."""
        return self._add([{**fields} for _ in range(count)], True, pause_s)

    def fault(self, *changes: dict[str, Any]) -> range:
        """Add a frame for each of these changes; none may be learned from. Their numbers."""
        return self._add(list(changes), False)

    def _add(self, changes: list[dict[str, Any]], good: bool, pause_s: float = 0.0) -> range:
        first = len(self.frames)
        for change in changes:
            seq = len(self.frames)
            values = {name: make(seq) for name, make in self._fields.items()}
            values |= {"seq": seq, "pts_ns": self.pts_ns, "image": scope_picture(seq), "status": FrameStatus.LIVE}
            self.frames.append(Scripted(Frame(**(values | change)), good, pause_s))
            self.pts_ns += INTERVAL_NS
            pause_s = 0.0
        return range(first, len(self.frames))


class ScriptedSource(LiveSource):
    """Plays a script in real time and drops none of it."""

    def __init__(self, script: Script, on_start: Callable[[], None], **options: Any) -> None:
        super().__init__(waiting=16, drops=False, stalled_after_s=0.5, **options)
        self._script, self._on_start = script, on_start
        self.description = SourceDescription(
            "scripted", WIDTH, HEIGHT, FPS, Camera.from_focal(60.0, WIDTH, HEIGHT), frozenset({"mask", "depth"})
        )

    def frames(self) -> Iterator[Frame]:
        """Each frame of the script at its time."""
        self._on_start()
        for scripted in self._script.frames:
            if self.wait(1 / FPS + scripted.pause_s):
                return
            yield replace(scripted.frame, arrived_ns=time.monotonic_ns())


@dataclass
class Watched:
    """A live run, and what it showed and trained on."""

    script: Script
    outcome: RunOutcome | None = None
    shown: list[ShownPicture] = field(default_factory=list)
    learned: set[int] = field(default_factory=set)
    """Numbers of the frames that were trained on."""

    def part(self, kind: type) -> Any:
        """Return an operator's part of the run's outcome."""
        assert self.outcome is not None
        found = self.outcome.find(kind)
        assert found is not None, kind
        return found

    def recovers_in(self, frames: range) -> None:
        """Among these frames some were learned from, and a live picture showed one of them."""
        assert self.learned & set(frames), f"none of the frames {frames} was trained on"
        assert any(
            picture.state is PictureState.LIVE and picture.rendered.trained and picture.rendered.frame.seq in frames
            for picture in self.shown
        ), f"none of the frames {frames} was shown live"

    def learned_nothing_bad(self) -> None:
        """No frame that is bad was trained on, and the model is sound."""
        bad = {k for k, scripted in enumerate(self.script.frames) if not scripted.good}
        assert not self.learned & bad
        assert self.outcome is not None
        assert self.part(TrainingCounts).frames == len(self.learned)
        # Loading refuses a model with NaN or infinity in it.
        assert load_bundle(self.outcome.outputs["model"]).gaussians.count > 0
        for picture in self.shown:
            assert picture.image.shape == picture.rendered.frame.image.shape
