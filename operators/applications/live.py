"""Live reconstruction and display of an endless stream.

                      depth (background thread)
                   ┌┈┈┈┈┈┘     └┈┈┈┐
source → analysis ─┴┬─► reconstruct ◄┘ → deform → rasterize → display ─┬─► sinks
                    └──────────────────────────► on_screen ◄───────────┘

Each operator has its own thread. Depth estimation runs in a background thread on the newest frame
and reaches training late. The queues into `reconstruct`, `rasterize` and `display` drop the oldest
frame and count dropped frames. Displayed pictures carry their age.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from gsplat_core.rendering.registry import check_renderer
from operators.applications.delivery import Report, delivered
from operators.applications.device import check_device
from operators.applications.finishing import saves_model
from operators.applications.limits import check_picture
from operators.applications.live_analysis import analysis_operator
from operators.applications.live_settings import LIVE_PREDICT_EVERY, LiveSettings
from operators.applications.live_start import LiveParts, low_latency, new_parts, warm_up
from operators.applications.recording import RunRecording
from operators.applications.replay import REPORT_RESERVE_BYTES
from operators.applications.result import RunOutcome
from operators.applications.session import Session
from operators.applications.trial_run import trial_run
from operators.applications.working_size import (
    SHARE_OF_INTERVAL,
    PacedTissue,
    WorkingSize,
    choose_working_size,
    measured_frame_s,
)
from operators.deform import DeformOp
from operators.depth_beside import DepthBeside, DepthBesideOp
from operators.display import DisplayOp
from operators.frame_clock import FrameClock
from operators.frame_log import FRAMES_FILE, FrameLog
from operators.graph import Application, MultiThreadScheduler
from operators.ingest import SourceOp
from operators.live_reconstruct import LiveReconstructOp
from operators.metrics import ScoredFrame
from operators.on_screen import OnScreenMetricsOp
from operators.pose import check_poses, pose_operators
from operators.rasterize import RasterizeOp
from operators.sinks.callback import CallbackSinkOp
from operators.sinks.keyframes import KeyframesOp
from operators.sources.options import SourceOptions
from operators.sources.registry import open_source
from operators.sources.scaled import ScaledSource, scaled_description
from operators.sources.source import FrameSource, SourceDescription
from operators.storage import StorageReserve


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
        beside = DepthBeside(settings.depth, self.frame_source.description.camera, device=settings.device)
        camera = self.frame_source.description.camera
        depth = (
            *pose_operators(self, settings.poses, camera, settings.depth),
            DepthBesideOp(self, name="depth", beside=beside),
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
            settings=settings.display,
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
