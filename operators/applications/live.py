"""Live reconstruction and display of an endless stream.

Analysis of a frame runs before training. Before the first frame, models and operators are warmed up and the interpreter is set for low latency.

                      depth (background thread)
                   ┌┈┈┈┈┈┘     └┈┈┈┐
source → analysis ─┴┬─► reconstruct ◄┘ → deform → rasterize → display ─┬─► sinks
                    └──────────────────────────► on_screen ◄───────────┘

Each operator has its own thread. Depth estimation runs in a background thread on the newest frame and reaches
training late. The queues into `reconstruct`, `rasterize` and `display` drop the oldest frame and count dropped
frames. Displayed pictures carry their age.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import cv2

from gsplat_core.rendering.registry import check_renderer
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.device import check_device, seeded
from operators.applications.limits import check_picture
from operators.applications.live_settings import LIVE_PREDICT_EVERY, LiveSettings
from operators.applications.recording import RunRecording
from operators.applications.replay import REPORT_RESERVE_BYTES
from operators.applications.session import Report, RunOutcome, Session, delivered, saves_model
from operators.applications.warm_reconstructor import warm_reconstructor
from operators.applications.working_size import (
    SHARE_OF_INTERVAL,
    PacedTissue,
    WorkingSize,
    choose_working_size,
    measured_frame_s,
    trial_run,
)
from operators.checks import (
    PICTURE_STAGES,
    TISSUE_STAGES,
    OrdinaryStream,
    PictureStagesOp,
    SceneNumberStage,
    StageOp,
    TissueStagesOp,
    new_stages,
)
from operators.choices import Policy
from operators.depth import BackgroundDepth, BackgroundDepthOp
from operators.display import DisplayOp
from operators.frame_clock import FrameClock
from operators.frame_log import FRAMES_FILE, FrameLog
from operators.graph import Application, MultiThreadScheduler, Operator
from operators.ingest import SourceOp
from operators.messages import DeformedScene
from operators.metrics import OnScreenMetricsOp, ScoredFrame
from operators.out_of_body import OutOfBodyGateOp
from operators.pose import check_poses, pose_operators
from operators.rasterize import DeformOp, RasterizeOp, Rasterizer
from operators.reconstruct import LiveReconstructOp
from operators.side_by_side import SideBySideOp
from operators.sinks.callback import CallbackSinkOp
from operators.sinks.keyframes import KeyframesOp
from operators.sources.address import SourceOptions
from operators.sources.derived import ScaledSource, scaled_description
from operators.sources.registry import open_source
from operators.sources.source import FrameSource, SourceDescription
from operators.storage import StorageReserve
from operators.tool_mask import new_tool_mask

BESIDE = "highlights"
"""A stage with no dependencies; runs concurrently with the other picture stages."""


def analysis_operator(
    fragment: Any,
    tool_mask: str,
    out_of_body: Policy,
    depth: Sequence[Operator],
    behind_gate: Sequence[Operator] = (),
    behind: Sequence[Operator] = (),
) -> Operator:
    """Return the operator between source and reconstruction, with the input and output `frame`.

    Tools and highlights are detected in parallel to the other checks of the picture.

    Args:
        fragment: the graph.
        tool_mask: tool detector, a name in `TOOL_MASKS`.
        out_of_body: policy for pictures from outside of the body.
        depth: operators that set the pose of a frame and select its recorded depth.
        behind_gate: operators inserted directly after the out-of-body gate.
        behind: operators appended at the end.
    """
    others = [name for name in PICTURE_STAGES if name != BESIDE]
    stream = OrdinaryStream()
    return SideBySideOp(
        fragment,
        name="analysis",
        gate=[OutOfBodyGateOp(fragment, name="out_of_body", policy=out_of_body)],
        first=[
            PictureStagesOp(
                fragment, name="picture", stages=new_stages(PICTURE_STAGES, without=[BESIDE]), stream=stream
            )
        ],
        beside=[
            [
                new_tool_mask(fragment, tool_mask),
                StageOp(fragment, name="highlights", stages=new_stages(PICTURE_STAGES, without=others)),
            ]
        ],
        then=[
            *behind_gate,
            *depth,
            TissueStagesOp(
                fragment,
                name="tissue",
                always=[*new_stages(TISSUE_STAGES, without=["exposure"]), SceneNumberStage()],
                stages=new_stages(TISSUE_STAGES, without=[name for name in TISSUE_STAGES if name != "exposure"]),
                stream=stream,
            ),
            *behind,
        ],
    )


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


def new_live_reconstructor(settings: LiveSettings, source: FrameSource) -> Reconstructor:
    """Create a reconstructor for the frames of a source."""
    camera = source.description.camera
    return Reconstructor(
        settings.reconstructor_config(camera.width_px * camera.height_px),
        camera,
        live=settings.chosen_training,
        seed=settings.seed,
        device=settings.device,
    )


@dataclass(frozen=True)
class LiveParts:
    """Components of a live session."""

    reconstructor: Reconstructor
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


class LiveApplication(Application):
    """Graph of a live run."""

    def __init__(
        self,
        source: FrameSource,
        settings: LiveSettings,
        parts: LiveParts,
        *,
        stop_requested: Callable[[], bool] = lambda: False,
        on_scored: Callable[[LiveApplication, ScoredFrame], None] | None = None,
        on_shown: Callable[[Any], None] | None = None,
    ) -> None:
        super().__init__(name="live", track=True)
        self.scheduler(MultiThreadScheduler(self))
        self.frame_source, self.settings, self._parts = source, settings, parts
        self.clock = FrameClock(settings.chosen_clock, source.description.fps)
        self._stop_requested = stop_requested
        self._on_scored, self._on_shown = on_scored, on_shown

    def compose(self) -> None:
        """Create and connect the operators (see the diagram of the module)."""
        settings, out = self.settings, self.settings.out
        reserve = StorageReserve(out, self.room_to_finish)
        self.source_op = SourceOp(
            self, name="source", source=self.frame_source, stop_requested=self._stop_requested, seconds=settings.seconds
        )
        recording = RunRecording(self, settings, self.frame_source.description, self.room_to_finish)
        beside = BackgroundDepth(settings.depth, self.frame_source.description.camera, device=settings.device)
        camera = self.frame_source.description.camera
        depth = (
            *pose_operators(self, settings.poses, camera, settings.depth),
            BackgroundDepthOp(self, name="depth", beside=beside),
        )
        analysis = analysis_operator(
            self, settings.tool_mask, settings.out_of_body, depth, recording.behind_gate(), recording.behind_analysis()
        )
        self.add_flow(self.source_op, analysis, {("frame", "frame")})
        self.reconstruct = LiveReconstructOp(
            self,
            name="reconstruct",
            make_reconstructor=recording.made_by(lambda: self._parts.reconstructor),
            clock=self.clock,
            listener=recording.listener,
            depth=beside,
        )
        deform = DeformOp(self, name="deform")
        rasterize = RasterizeOp(
            self,
            name="rasterize",
            renderer=settings.renderer,
            predict_every=LIVE_PREDICT_EVERY[settings.device],
            rasterizer=self._parts.rasterizer,
        )
        self.display = DisplayOp(
            self,
            name="display",
            clock=self.clock,
            source_state=lambda: self.frame_source.state,
        )
        log = FrameLog(out / FRAMES_FILE, reserve) if settings.report else None
        self.metrics = OnScreenMetricsOp(self, name="on_screen", log=log, report=settings.report)
        self.add_flow(analysis, self.reconstruct, {("frame", "frame")})
        self.add_flow(
            self.reconstruct, deform, {("reconstruction", "reconstruction")}, policy="drop_oldest", capacity=2
        )
        self.add_flow(deform, rasterize, {("scene", "scene")}, policy="drop_oldest", capacity=2)
        self.add_flow(rasterize, self.display, {("rendered", "rendered")})
        recording.pictures_of(self.display)
        self.add_flow(analysis, self.metrics, {("frame", "frame")})
        self.add_flow(self.display, self.metrics, {("shown", "shown")})
        self.add_flow(rasterize, self.metrics, {("predicted", "predicted")})
        if self._on_shown is not None:
            shown = CallbackSinkOp(self, name="viewer", callback=self._on_shown)
            self.add_flow(self.display, shown, {("shown", "message")}, policy="drop_oldest")
        if settings.report:
            keyframes = KeyframesOp(self, name="keyframes")
            self.add_flow(self.metrics, keyframes, {("scored", "scored")}, policy="drop_oldest", capacity=4)
        if self._on_scored is not None:
            report = self._on_scored
            progress = CallbackSinkOp(self, name="progress", callback=lambda scored: report(self, scored))
            self.add_flow(self.metrics, progress, {("scored", "message")}, policy="drop_oldest")

    def room_to_finish(self) -> int:
        """Return the disk space that finishing needs, in bytes: the newest model in float32 and the
        report.
        """
        return REPORT_RESERVE_BYTES + 4 * self.reconstruct.parameter_count


def live(
    settings: LiveSettings,
    *,
    stop_requested: Callable[[], bool] = lambda: False,
    on_scored: Callable[[LiveApplication, ScoredFrame], None] | None = None,
    on_shown: Callable[[Any], None] | None = None,
    report: Report | None = None,
) -> RunOutcome:
    """Reconstruct a source until it ends, the duration elapses or a stop is requested, and write
    the results.

    Args:
        settings: settings of the run.
        stop_requested: polled; True ends the run.
        on_scored: called for each scored frame with the graph.
        on_shown: called with each `ShownPicture`.
        report: writes the report files; None for no report.

    Raises:
        UserError: invalid settings, raised before anything is written.
        RunFailed: a component failed; carries the outcome, and the results so far are saved.
    """

    def run(inside: LiveSettings, notes: list[str]) -> RunOutcome:
        source = prepare(inside, notes)
        with low_latency():
            inside, source = on_trial(inside, source, notes)
            graph = LiveApplication(
                source,
                inside,
                warm_up(inside, source),
                stop_requested=stop_requested,
                on_scored=on_scored,
                on_shown=on_shown,
            )
            return Session(
                graph,
                inside.stated(),
                command="live",
                finish=[saves_model(inside.out)],
                notes=notes,
                stop_requested=stop_requested,
            ).execute()

    return delivered(settings, "live", run, report)


def measured_size(settings: LiveSettings, about: SourceDescription, share: float = SHARE_OF_INTERVAL) -> WorkingSize:
    """Find the largest size at which this machine keeps up with a stream, by trial runs at several
    sizes.

    Args:
        settings: settings of the run.
        about: description of the stream.
        share: share of the frame interval that a frame may take.
    """

    def paced(tissue: PacedTissue, tried: LiveSettings) -> LiveApplication:
        return LiveApplication(tissue, tried, new_parts(tried, tissue), on_shown=tissue.shown)

    return choose_working_size(
        about,
        lambda scale: measured_frame_s(replace(settings, scale=scale), scaled_description(about, scale), paced),
        share,
    )


def on_trial(settings: LiveSettings, source: FrameSource, notes: list[str]) -> tuple[LiveSettings, FrameSource]:
    """Perform the trial run and select the working size.

    On a CPU without a given scale the working size is measured.

    Args:
        settings: settings of the run.
        source: the source at the given scale.
        notes: list that receives the selected size as a sentence.

    Returns:
        The settings and the source at the working size.
    """
    if settings.device != "cpu" or settings.scale is not None:
        trial_run(settings, source, lambda made_up, tried: LiveApplication(made_up, tried, new_parts(tried, source)))
        return settings, source
    chosen = measured_size(settings, source.description)
    notes.append(chosen.sentence)
    settings = replace(settings, scale=chosen.scale)
    return settings, source if chosen.scale == 1 else ScaledSource(source, chosen.scale)


def prepare(settings: LiveSettings, notes: list[str]) -> FrameSource:
    """Perform all checks that are possible before the first frame.

    Args:
        settings: settings of the run.
        notes: list that receives notes for the report.

    Returns:
        The source, not yet opened.

    Raises:
        UserError: as `live` raises it before anything is written.
    """
    check_device(settings.device)
    check_renderer(settings.renderer, settings.device)
    source = open_source(
        settings.source,
        SourceOptions(
            settings.given_scale,
            settings.max_frames,
            realtime=True,
            loop=settings.loop,
            fps=settings.fps,
            process=True,
        ),
    )
    check_picture(source.description.camera, settings.given_scale)
    check_poses(settings.poses, source.description.camera)
    notes.extend(source.description.notes)
    StorageReserve(settings.out, lambda: REPORT_RESERVE_BYTES).require()
    return source
