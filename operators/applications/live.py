"""Live: a stream is reconstructed and shown beside a clock, without an end.

    source → sequence → tool_mask → scene ─┬─► reconstruct → deform → rasterize → display ─┬─► sinks
                                           └───────────────────────► on_screen ◄───────────┘

Each operator has a thread of its own. The newest frame wins wherever one comes too late: into `reconstruct`, into `rasterize` and into
`display`; every frame that is passed over is counted by the edge. What is shown says how old it is.
"""

from __future__ import annotations

import dataclasses
import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.sessions import WriterOptions
from gsplat_core.rendering.registry import check_renderer, new_renderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.budget import Budget
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.live import LiveReconstructor, LiveTraining
from operators.applications.delivery import Report, delivered
from operators.applications.device import check_device, seeded
from operators.applications.finishing import saves_model
from operators.applications.limits import check_max_frames, check_picture, check_scale, check_seed
from operators.applications.live_analysis import analysis_operators
from operators.applications.recording import RunRecording
from operators.applications.replay import PIXELS_PER_GAUSSIAN, REPORT_RESERVE_BYTES
from operators.applications.result import RunOutcome, RunSettings
from operators.applications.session import Session
from operators.deform import DeformOp
from operators.display import DisplayOp, DisplaySettings, labelled
from operators.frame_clock import ClockSettings, FrameClock
from operators.frame_log import FRAMES_FILE, FrameLog
from operators.graph import Application, MultiThreadScheduler, Operator
from operators.ingest import SourceOp
from operators.live_reconstruct import LiveReconstructOp
from operators.messages import PictureState
from operators.metrics import ScoredFrame
from operators.on_screen import OnScreenMetricsOp
from operators.rasterize import RasterizeOp
from operators.sinks.callback import CallbackSinkOp
from operators.sinks.keyframes import KeyframesOp
from operators.sources.registry import SourceOptions, open_source
from operators.sources.source import FrameSource
from operators.storage import StorageReserve

SWITCH_INTERVAL_S = 0.0002
"""How long a thread may keep Python's interpreter while another one waits for it: a frame must not wait for 5 ms, the default."""
LIVE_WINDOW_FRAMES = 150
LIVE_BUMP_SPACING_S = 0.1
LIVE_SSIM_WEIGHT = {"cpu": 0.0, "cuda": 0.1}
"""Beside L1: follows motion better. On a CPU a step takes half as long again with it, and steps are what is short there."""


@dataclass(frozen=True)
class LiveSettings:
    """What to reconstruct live, how, and where the results go. Raises InvalidSetting for a value out of its range."""

    source: str
    """An address (see `open_source`)."""
    out: Path
    device: str = "cpu"
    field: str = "auto"
    renderer: str = "alpha"
    seed: int = 0
    scale: float = 1.0
    max_frames: int | None = None
    seconds: float | None = None
    """End after so long; None: when the source ends or the run is interrupted."""
    loop: bool = False
    """Play a recording again and again."""
    fps: float | None = None
    """Play a recording at this rate instead of its own."""
    record: Path | None = None
    """Record the session into this folder, which is not there yet; None: it is not recorded."""
    recording: WriterOptions = dataclasses.field(default_factory=WriterOptions)
    """How it is recorded."""
    tool_mask: str = "builtin"
    """How tools are found in frames that come without a mask (`operators.tool_mask.TOOL_MASKS`)."""
    clock: ClockSettings = dataclasses.field(default_factory=ClockSettings)
    display: DisplaySettings = dataclasses.field(default_factory=DisplaySettings)
    training: LiveTraining = dataclasses.field(default_factory=LiveTraining)

    def __post_init__(self) -> None:
        check_seed(self.seed)
        check_scale(self.scale)
        check_max_frames(self.max_frames)
        if self.seconds is not None and not 0 < self.seconds < 1e9:
            raise InvalidSetting(f"seconds is {self.seconds:g}; it must be positive")
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise InvalidSetting(f"fps is {self.fps:g}; it must be above 0 and at most 1000")

    @property
    def inputs(self) -> tuple[Path, ...]:
        """What the run reads from the disk."""
        path = Path(self.source)
        return (path,) if path.exists() else ()

    def reconstructor_config(self, pixels: int) -> ReconstructorConfig:
        """The reconstructor's settings for frames of so many pixels. Raises InvalidSetting."""
        config = ReconstructorConfig(
            field=self.field,
            window_frames=LIVE_WINDOW_FRAMES,
            bump_spacing_s=LIVE_BUMP_SPACING_S,
            ssim_weight=LIVE_SSIM_WEIGHT[self.device],
        )
        most = max(64, pixels // PIXELS_PER_GAUSSIAN)
        return replace(config, gaussians=min(config.gaussians, most), max_gaussians=min(config.max_gaussians, 2 * most))

    def stated(self) -> RunSettings:
        """What the report says about them."""
        return RunSettings(
            device=self.device,
            engine="embedded",
            field=ReconstructorConfig(field=self.field).chosen_field,
            renderer=self.renderer,
            seed=self.seed,
            scale=self.scale,
            steps_per_frame=None,
            heldout=False,
        )


class LiveApplication(Application):
    """Composes the graph."""

    def __init__(
        self,
        source: FrameSource,
        settings: LiveSettings,
        *,
        stop_requested: Callable[[], bool] = lambda: False,
        on_scored: Callable[[LiveApplication, ScoredFrame], None] | None = None,
        on_shown: Callable[[Any], None] | None = None,
    ) -> None:
        super().__init__(name="live", track=True)
        self.scheduler(MultiThreadScheduler(self))
        self.frame_source, self.settings = source, settings
        self.clock = FrameClock(settings.clock, source.description.fps)
        self._stop_requested = stop_requested
        self._on_scored, self._on_shown = on_scored, on_shown

    def compose(self) -> None:
        """Wire the operators; see the module's picture."""
        settings, out = self.settings, self.settings.out
        reserve = StorageReserve(out, self.room_to_finish)
        self.source_op = SourceOp(self, name="source", source=self.frame_source, stop_requested=self._stop_requested)
        recording = RunRecording(self, settings, self.frame_source.description, self.room_to_finish)
        last: Operator = self.source_op
        for operator in recording.analysis(analysis_operators(self, settings.tool_mask)):
            self.add_flow(last, operator, {("frame", "frame")})
            last = operator
        self.reconstruct = LiveReconstructOp(
            self,
            name="reconstruct",
            make_reconstructor=recording.made_by(lambda: new_live_reconstructor(settings, self.frame_source)),
            clock=self.clock,
            listener=recording.listener,
        )
        deform = DeformOp(self, name="deform")
        rasterize = RasterizeOp(self, name="rasterize", renderer=settings.renderer)
        self.display = DisplayOp(
            self,
            name="display",
            clock=self.clock,
            source_state=lambda: self.frame_source.state,
            settings=settings.display,
        )
        self.metrics = OnScreenMetricsOp(self, name="on_screen", log=FrameLog(out / FRAMES_FILE, reserve))
        self.add_flow(last, self.reconstruct, {("frame", "frame")})
        self.add_flow(
            self.reconstruct, deform, {("reconstruction", "reconstruction")}, policy="drop_oldest", capacity=2
        )
        self.add_flow(deform, rasterize, {("scene", "scene")}, policy="drop_oldest", capacity=2)
        self.add_flow(rasterize, self.display, {("rendered", "rendered")})
        recording.pictures_of(self.display)
        self.add_flow(last, self.metrics, {("frame", "frame")})
        self.add_flow(self.display, self.metrics, {("shown", "shown")})
        if self._on_shown is not None:
            shown = CallbackSinkOp(self, name="viewer", callback=self._on_shown)
            self.add_flow(self.display, shown, {("shown", "message")}, policy="drop_oldest")
        keyframes = KeyframesOp(self, name="keyframes")
        self.add_flow(self.metrics, keyframes, {("scored", "scored")}, policy="drop_oldest", capacity=4)
        if self._on_scored is not None:
            report = self._on_scored
            progress = CallbackSinkOp(self, name="progress", callback=lambda scored: report(self, scored))
            self.add_flow(self.metrics, progress, {("scored", "message")}, policy="drop_oldest")

    def room_to_finish(self) -> int:
        """Bytes on the disk that finishing needs: the newest model, in float32, and the report."""
        model = self.reconstruct.newest
        return REPORT_RESERVE_BYTES + (0 if model is None else 4 * model.parameter_count)


def live(
    settings: LiveSettings,
    *,
    stop_requested: Callable[[], bool] = lambda: False,
    on_scored: Callable[[LiveApplication, ScoredFrame], None] | None = None,
    on_shown: Callable[[Any], None] | None = None,
    report: Report | None = None,
) -> RunOutcome:
    """Reconstruct a source live until it ends, the time is over, or the run is asked to stop; what was reached is written in any case.

    Raises a UserError before anything is written for settings that cannot work, and RunFailed, with the outcome, when a part failed.
    """

    def run(inside: LiveSettings, notes: list[str]) -> RunOutcome:
        source = prepare(inside, notes)
        graph = LiveApplication(source, inside, stop_requested=stop_requested, on_scored=on_scored, on_shown=on_shown)
        warm_up(inside, source)
        with low_latency():
            return Session(
                graph,
                inside.stated(),
                command="live",
                finish=[saves_model(inside.out)],
                notes=notes,
                stop_requested=stop_requested,
            ).execute()

    return delivered(settings, "live", run, report)


def prepare(settings: LiveSettings, notes: list[str]) -> FrameSource:
    """Check everything that can be checked before the first frame; returns the source, and adds what is to be said about it to `notes`.

    Raises as `live` does before anything is written.
    """
    check_device(settings.device)
    check_renderer(settings.renderer, settings.device)
    source = open_source(
        settings.source,
        SourceOptions(
            settings.scale, settings.max_frames, realtime=True, loop=settings.loop, fps=settings.fps, process=True
        ),
    )
    check_picture(source.description.camera, settings.scale)
    notes.extend(source.description.notes)
    StorageReserve(settings.out, lambda: REPORT_RESERVE_BYTES).require()
    return source


def new_live_reconstructor(settings: LiveSettings, source: FrameSource) -> LiveReconstructor:
    """A reconstructor for the frames of a source."""
    camera = source.description.camera
    return LiveReconstructor(
        settings.reconstructor_config(camera.width_px * camera.height_px),
        camera,
        live=settings.training,
        seed=settings.seed,
        device=settings.device,
    )


def warm_up(settings: LiveSettings, source: FrameSource) -> None:
    """Do everything once that takes long the first time: kernels are loaded, memory is taken, threads are started. The stream's first
    frame then has to wait for none of it."""
    camera: Camera = source.description.camera
    noise = np.random.default_rng(0).integers(0, 256, (camera.height_px, camera.width_px, 3), np.uint8)
    with seeded(settings.seed, settings.device):
        reconstructor = new_live_reconstructor(settings, source)
        renderer = new_renderer(settings.renderer, camera, reconstructor.device)
        for seq in range(3):
            reconstructor.observe(Frame(seq, seq * 33_000_000, noise), budget=Budget.of_steps(3))
            renderer.prepare(reconstructor.publish())
            renderer.render(camera, seq * 0.033).result()
            reconstructor.rehearse(2)
    labelled(noise, PictureState.LIVE, 0)


@contextmanager
def low_latency() -> Iterator[None]:
    """Inside, threads take turns often, and what exists already is never searched for garbage again."""
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(interval_s)
