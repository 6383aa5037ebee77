"""Live: a stream is reconstructed and shown beside a clock, without an end.

                          depth (beside)
                       ┌┈┈┈┈┈┘     └┈┈┈┐
    source → analysis ─┴┬─► reconstruct ◄┘ → deform → rasterize → display ─┬─► sinks
                        └──────────────────────────► on_screen ◄───────────┘

Each operator has a thread of its own, and so has depth, which nothing waits for: it is found for the newest frame and reaches training when it is there. The newest frame wins wherever one comes too late: into `reconstruct`, into `rasterize` and into
`display`; every frame that is passed over is counted by the edge. What is shown says how old it is.
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
    """Composes the graph."""

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
        """Wire the operators; see the module's picture."""
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
        """Bytes on the disk that finishing needs: the newest model, in float32, and the report."""
        return REPORT_RESERVE_BYTES + 4 * self.reconstruct.parameter_count


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
    """Choose the size at which this machine keeps up with a stream; runs the graph at several sizes on trial.

    share: of the time between two frames that a frame may take.
    """

    def paced(tissue: PacedTissue, tried: LiveSettings) -> LiveApplication:
        return LiveApplication(tissue, tried, new_parts(tried, tissue), on_shown=tissue.shown)

    return choose_working_size(
        about,
        lambda scale: measured_frame_s(replace(settings, scale=scale), scaled_description(about, scale), paced),
        share,
    )


def on_trial(settings: LiveSettings, source: FrameSource, notes: list[str]) -> tuple[LiveSettings, FrameSource]:
    """Run the graph on trial; returns the settings and the source at the size that the run works at.

    Where no scale was given, a run on a CPU chooses it by what this machine measures, and says so in `notes`.
    """
    if settings.device != "cpu" or settings.scale is not None:
        trial_run(settings, source, lambda made_up, tried: LiveApplication(made_up, tried, new_parts(tried, source)))
        return settings, source
    chosen = measured_size(settings, source.description)
    notes.append(chosen.sentence)
    settings = replace(settings, scale=chosen.scale)
    return settings, source if chosen.scale == 1 else ScaledSource(source, chosen.scale)


def prepare(settings: LiveSettings, notes: list[str]) -> FrameSource:
    """Check everything that can be checked before the first frame; returns the source, and adds what is to be said about it to `notes`.

    Raises as `live` does before anything is written.
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
