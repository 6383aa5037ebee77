"""Measured working size of a live run on a CPU: the largest at which each frame is displayed before the next.

The live graph runs on synthetic pictures, one at a time, with the minimum number of steps per frame. The latency from a frame's arrival to its picture is
measured. The measurement also serves as the trial run, so that one-time initialisation is done before the first frame.
"""

from __future__ import annotations

import itertools
import math
import statistics
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.frames import Frame, FrameStatus
from operators.applications.live_settings import LiveSettings
from operators.applications.session import seeded
from operators.graph import Application, run
from operators.messages import ShownPicture
from operators.sources.derived import scaled_description
from operators.sources.source import FrameSource, SourceDescription, ThreadedSource

TRIAL_FRAMES = 10
TRIAL_INTERVAL_S = 0.02


class MadeUpTissue(ThreadedSource):
    """Source of a few synthetic tissue pictures with motion, with the properties of the source description `like`."""

    def __init__(self, like: SourceDescription) -> None:
        super().__init__(ahead=1)
        self.description = replace(
            like, name="trial run", fps=1 / TRIAL_INTERVAL_S, frame_count=None, digest=None, notes=()
        )

    def frames(self) -> Iterator[Frame]:
        """Yield the pictures in real time."""
        camera = self.description.camera
        picture = made_up_tissue(camera.height_px, camera.width_px)
        for seq in range(TRIAL_FRAMES):
            time.sleep(TRIAL_INTERVAL_S)
            moved = np.roll(picture, 2 * seq, axis=1)
            yield Frame(
                seq,
                round(seq * TRIAL_INTERVAL_S * 1e9),
                moved,
                status=FrameStatus.LIVE,
                arrived_ns=time.monotonic_ns(),
            )


def made_up_tissue(height_px: int, width_px: int) -> NDArray[np.uint8]:
    """Return a synthetic tissue picture of smooth red patches, uint8 RGB [H, W, 3]."""
    random = np.random.default_rng(0)
    patches = random.uniform(0.4, 1.0, (24, 30)).astype(np.float32)
    light = cv2.resize(patches, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    return np.clip(light[..., None] * np.array([190, 90, 80], np.float32), 0, 255).astype(np.uint8)


def trial_run(
    settings: LiveSettings, source: FrameSource, new_graph: Callable[[FrameSource, LiveSettings], Application]
) -> None:
    """Run the graph made by `new_graph` on synthetic pictures, to detect failures before the stream.

    Args:
        settings: settings of the live run.
        source: source of the stream; only its description is used.
        new_graph: creates the graph from a source and settings.

    Raises:
        OperatorsError: the errors of a run, such as OperatorFailed.
    """
    run_on_trial(settings, lambda inside: new_graph(MadeUpTissue(source.description), inside))


def run_on_trial(settings: LiveSettings, new_graph: Callable[[LiveSettings], Application]) -> None:
    """Run a live graph without recording, in a temporary folder. Raises the errors of a run."""
    with TemporaryDirectory(prefix="intrasplat-trial-") as folder:
        inside = replace(settings, out=Path(folder), record=None, out_of_body="off", seconds=None, max_frames=None)
        with seeded(settings.seed, settings.device):
            run(new_graph(inside), "embedded")


SCALE_STEPS = 16
"""Number of size steps up to the full size: the tried scales are multiples of 1 / `SCALE_STEPS`."""
MIN_SIDE_PX = 64
"""Minimum side of a working size, in pixels."""
FIRST_PIXELS = 320 * 256
"""Number of pixels of the first measured picture size, for streams with more pixels."""
SHARE_OF_INTERVAL = 0.65
"""Largest share of the frame interval that the latency of a synthetic frame may take. Recorded frames take longer: with 0.8,
up to 108 of 150 frames were late on two idle cores (results/live.md)."""
MOST_MEASUREMENTS = 6
NEIGHBOURS = 2
"""Largest distance, in size steps, between the chosen size and a neighbouring size that is measured to confirm the choice."""
ROUNDING = 1e-9
"""Relative tolerance of a latency, so that a size that just fits is not lost by rounding."""
STARTING_FRAMES, TIMED_FRAMES = 3, 9
"""Number of frames per measurement: frames that initialise the model and are not timed, then timed frames."""
GIVEN_UP_S = 2.0
"""Timeout of a frame in seconds, stored as the frame's latency. After the timeout of a timed frame no further frames are
measured; after that of a starting frame the next one follows.
"""


@dataclass(frozen=True)
class WorkingSize:
    """Chosen working size and its measurement."""

    scale: float
    width_px: int
    height_px: int
    frame_s: float
    """Latency from a frame's arrival to its picture at this size, in seconds."""
    interval_s: float
    """Frame interval of the stream, in seconds."""
    full_size: tuple[int, int]
    """Width and height of the stream's pictures, in pixels."""

    @property
    def sentence(self) -> str:
        """The chosen working size and the reason for it, as a sentence for the report."""
        size, full = f"{self.width_px}x{self.height_px}", "{}x{}".format(*self.full_size)
        of = f"all {size} pixels" if self.scale == 1 else f"{size} of {full} pixels"
        took, between = f"{1e3 * self.frame_s:.0f} ms", f"{1e3 * self.interval_s:.0f} ms"
        if self.frame_s <= self.interval_s:
            why = f"a frame takes {took} at this size on this machine, and frames come {between} apart"
        else:
            why = f"even at this size a frame takes {took} on this machine, and frames come {between} apart, so some of them are passed over"
        return f"the run reconstructs {of}: {why}; --scale sets another size"


def choose_working_size(
    about: SourceDescription, measure: Callable[[float], float], share: float = SHARE_OF_INTERVAL
) -> WorkingSize:
    """Choose the largest size whose frames take at most `share` of the frame interval.

    The latency is a fixed time and a time per pixel, fitted to measurements at several sizes near the chosen one. A single
    measurement that other load disturbed therefore changes the choice by little.

    Args:
        about: description of the stream at full size.
        measure: returns the latency of a frame in seconds at a scale; called at most `MOST_MEASUREMENTS` times.
        share: share of the frame interval that a frame may take.
    """
    interval_s = 1 / about.fps
    smallest = min(SCALE_STEPS, math.ceil(SCALE_STEPS * MIN_SIDE_PX / min(about.width_px, about.height_px)))
    guess = math.floor(SCALE_STEPS * math.sqrt(FIRST_PIXELS / (about.width_px * about.height_px)))
    sizes = range(smallest, SCALE_STEPS + 1)
    step: int | None = min(SCALE_STEPS, max(smallest, guess))
    measured: dict[int, float] = {}
    while step is not None and len(measured) < MOST_MEASUREMENTS:
        measured[step] = measure(step / SCALE_STEPS)
        latency = Latency.of(measured)
        chosen = latency.largest(sizes, share * interval_s)
        step = _next_to_measure(chosen, measured, sizes, share * interval_s)
    scaled = scaled_description(about, chosen / SCALE_STEPS)
    return WorkingSize(
        scale=chosen / SCALE_STEPS,
        width_px=scaled.width_px,
        height_px=scaled.height_px,
        frame_s=latency.at(chosen),
        interval_s=interval_s,
        full_size=(about.width_px, about.height_px),
    )


def lower_quartile(values: Iterable[float]) -> float:
    """Return the lower quartile: the value that a quarter of the values are below; the smallest of fewer than four values.

    Other load only lengthens frames, so small values vary less from run to run than the median.
    """
    ordered = sorted(values)
    return ordered[len(ordered) // 4]


@dataclass(frozen=True)
class Latency:
    """Latency of a frame as a function of the picture size in size steps (see `SCALE_STEPS`): a fixed time and a time per pixel."""

    fixed_s: float
    each_s: float
    """Seconds per squared size step. The number of pixels is proportional to the square of the step."""

    @classmethod
    def of(cls, measured: Mapping[int, float]) -> Latency:
        """Fit the latency to measurements in seconds by size step: the median slope of all pairs (Theil 1950, Sen 1968).

        Without a positive slope, which a single measurement or other load can cause, the time is proportional to the
        number of pixels.
        """
        pairs = itertools.combinations(sorted(measured.items()), 2)
        slopes = [(later_s - earlier_s) / (b**2 - a**2) for (a, earlier_s), (b, later_s) in pairs]
        each_s = statistics.median(slopes) if slopes else 0.0
        fixed_s = lower_quartile(took_s - each_s * step**2 for step, took_s in measured.items())
        if each_s <= 0 or fixed_s < 0:
            return cls(0.0, lower_quartile(took_s / step**2 for step, took_s in measured.items()))
        return cls(fixed_s, each_s)

    def at(self, step: int) -> float:
        """Return the latency in seconds of a frame at the scale `step` / `SCALE_STEPS`."""
        return self.fixed_s + self.each_s * step**2

    def largest(self, sizes: Sequence[int], allowed_s: float) -> int:
        """Return the largest of the size steps `sizes` at which a frame takes at most `allowed_s` seconds; if none, the smallest."""
        return max((step for step in sizes if self.at(step) <= allowed_s * (1 + ROUNDING)), default=min(sizes))


def _next_to_measure(chosen: int, measured: Mapping[int, float], sizes: Sequence[int], allowed_s: float) -> int | None:
    """Return the size step to measure next: the chosen one, or else its nearest neighbour, larger ones first.

    Returns None if nothing near is left, or if the largest size was measured to fit.
    """
    if chosen not in measured:
        return chosen
    if chosen == max(sizes) and measured[chosen] <= allowed_s:
        return None
    near = [step for step in sizes if step not in measured and abs(step - chosen) <= NEIGHBOURS]
    return min(near, key=lambda step: (abs(step - chosen), -step), default=None)


class PacedTissue(ThreadedSource):
    """Source of synthetic pictures that emits a picture after the previous picture was displayed, and measures the
    latency."""

    def __init__(self, like: SourceDescription) -> None:
        super().__init__(ahead=1)
        self.description = replace(like, name="trial run", frame_count=None, digest=None, notes=())
        self.took_s: dict[int, float] = {}
        """Latency of each frame in seconds, by sequence number."""
        self._shown = threading.Event()
        self._given: tuple[int, int] | None = None
        """Sequence number and arrival time in nanoseconds of the newest frame."""

    def frames(self) -> Iterator[Frame]:
        """Yield the pictures with the stream's timestamps, waiting for the display of each."""
        camera, fps = self.description.camera, self.description.fps
        picture = made_up_tissue(camera.height_px, camera.width_px)
        for seq in range(STARTING_FRAMES + TIMED_FRAMES):
            self._shown.clear()
            self._given = seq, time.monotonic_ns()
            moved = np.roll(picture, 2 * seq, axis=1)
            yield Frame(seq, round(seq / fps * 1e9), moved, status=FrameStatus.LIVE, arrived_ns=self._given[1])
            if not self._shown.wait(GIVEN_UP_S):
                self.took_s[seq] = GIVEN_UP_S
                if seq >= STARTING_FRAMES:
                    return

    def shown(self, picture: ShownPicture) -> None:
        """Store the latency of the newest frame when its picture is displayed, which lets `frames` yield the next
        frame.
        """
        if picture.new and self._given is not None and picture.rendered.frame.seq == self._given[0]:
            self.took_s[self._given[0]] = (picture.shown_ns - self._given[1]) * 1e-9
            self._shown.set()

    @property
    def frame_s(self) -> float:
        """Lower quartile of the latencies of the timed frames in seconds; `GIVEN_UP_S` if no frame was displayed."""
        timed = [took_s for seq, took_s in self.took_s.items() if seq >= STARTING_FRAMES]
        return lower_quartile(timed or [GIVEN_UP_S])


def measured_frame_s(
    settings: LiveSettings, about: SourceDescription, new_graph: Callable[[PacedTissue, LiveSettings], Application]
) -> float:
    """Run the graph made by `new_graph` on paced pictures and return the latency of a frame in seconds.

    Args:
        settings: settings of the live run; the number of steps is set to the minimum.
        about: description of the stream at the size to be measured.
        new_graph: creates the graph for the pictures and settings.

    Raises:
        RunFailed: as for a run.
    """
    clock = settings.chosen_clock
    fewest = clock.at_least_steps or 1
    tissue = PacedTissue(about)
    paced = replace(settings, clock=replace(clock, at_most_steps=fewest, rehearse_at_most=0))
    run_on_trial(paced, lambda tried: new_graph(tissue, tried))
    return tissue.frame_s
