"""Graph of a run, from the source to the sinks.

source ─► analysis ─► reconstruct ─► deform ─► rasterize ─┬─► display ─► viewer, session recorder
             │             ▲                              │      │
             └─► depth ┈┈┈┈┘                              └──────┴─► metrics ─► sinks, progress

`analysis` checks the picture, finds tools, and sets pose and depth. All runs use this graph. They differ in the source, the `Pace` and the
sinks:

- A replay, also of a finished model, has no clock. Every edge blocks and holds one message, and the work per frame is a number of steps. The same source,
  settings and device therefore give the same pictures on either engine and with any number of threads. Its pictures have no age, so there is no display.
- The replay of a recorded session repeats the recorded calls of training. Its frames were analysed when they were recorded.
- A live stream has a clock. Each operator has its own thread, and the queues between them drop the oldest frame. Depth is estimated in a background thread
  on the newest frame and reaches training late.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_core.io.recordings.truth import TissueBehindTools
from gsplat_core.io.sessions import SessionReader
from gsplat_core.scene.frames import Frame
from gsplat_core.training.reconstructor import Reconstructor
from operators.applications.session import scheduler_for
from operators.checks import (
    MaskAndDepthStage,
    OutOfBodyGateOp,
    PictureStagesOp,
    SceneNumberStage,
    StageOp,
    picture_stages,
)
from operators.depth import DepthOp
from operators.display import DisplayOp
from operators.frame_clock import BehindGuard, FrameClock
from operators.frame_log import FRAMES_FILE, FrameLog
from operators.graph import Application, GreedyScheduler, MultiThreadScheduler, Operator, OperatorSpec
from operators.ingest import SourceOp
from operators.messages import RenderedFrame, ShownPicture
from operators.metrics import CompareShownOp, MetricsOp, ScoredFrame
from operators.outcome import Contributor, OutcomeBuilder
from operators.pose import pose_operators
from operators.rasterize import DeformOp, RasterizeOp, Rasterizer
from operators.reconstruct import ReconstructOp
from operators.settings import SINKS, EngineOptions, JobOptions, OutputSection, Policy
from operators.sinks.session_recorder import RecordFramesOp, RecordPicturesOp, RecordPreparationOp, SessionRecorder
from operators.sinks.sink import CallbackSinkOp, SinkOptions, input_of
from operators.sinks.video import OutputVideosOp
from operators.sources.source import FrameSource
from operators.storage import StorageReserve
from operators.tool_mask import RecordedToolMaskOp, new_tool_mask
from operators.training import EveryFrame, RecordedCalls, Training, UntilDisplay
from operators.truth import TruthOp

REPORT_RESERVE_BYTES = 8 * 2**20
"""Disk space reserved for the video's index and the report, in bytes."""


def analysis_operator(
    fragment: Any,
    tool_mask: str,
    out_of_body: Policy,
    positions: Sequence[Operator] = (),
    *,
    behind_gate: Sequence[Operator] = (),
    behind: Sequence[Operator] = (),
    device: str = "cpu",
) -> SideBySideOp:
    """Return the operator between source and reconstruction, with the input and output `frame`.

    Tools are detected in parallel to the other checks of the picture.

    Args:
        fragment: the graph.
        tool_mask: tool detector, a name in `TOOL_MASKS`.
        out_of_body: policy for pictures from outside of the body.
        positions: operators that set pose and depth of a frame.
        behind_gate: operators inserted directly after the out-of-body gate.
        behind: operators appended at the end.
        device: device of the built-in tool network.
    """
    return SideBySideOp(
        fragment,
        name="analysis",
        gate=[OutOfBodyGateOp(fragment, name="out_of_body", policy=out_of_body)],
        first=[PictureStagesOp(fragment, name="picture", stages=picture_stages())],
        beside=[new_tool_mask(fragment, tool_mask, device=device)],
        then=[
            *behind_gate,
            *positions,
            StageOp(fragment, name="tissue", stages=[MaskAndDepthStage(), SceneNumberStage()]),
            *behind,
        ],
    )


@dataclass(frozen=True)
class Pace:
    """Timing of a run: scheduler, queues, and training per frame."""

    clock: FrameClock | None = None
    """Display deadlines of a live stream. None to process every frame without deadlines."""
    session: SessionReader | None = None
    """Recorded session whose training calls are replayed; None for a plain recording."""
    held_out: Callable[[Frame], bool] = lambda frame: False
    """Returns True for frames that are displayed and scored but not trained on.

    Ignored with a clock or a session.
    """
    predict_every: int = 1
    """Predict one in this many frames before training on it; 0 for a finished model."""
    guard: BehindGuard = field(default_factory=BehindGuard)
    """Comparison of live pictures with trivial ones, which has the model started anew if it falls behind. Shared by training and
    display."""

    def scheduler(self, device: str, graph: Application) -> GreedyScheduler | MultiThreadScheduler:
        """Return the scheduler: one thread per operator for a live stream, otherwise that of `scheduler_for`."""
        return scheduler_for(device, graph) if self.clock is None else MultiThreadScheduler(graph)

    def queue(self, capacity: int) -> dict[str, Any]:
        """Return the arguments of `add_flow` for an edge. With a clock it holds up to `capacity`
        messages and drops the oldest one.
        """
        return {} if self.clock is None else {"policy": "drop_oldest", "capacity": capacity}

    def training(self, depth: DepthOp, stop_requested: Callable[[], bool]) -> Training:
        """Return the policy that decides how much each frame is trained on.

        Args:
            depth: the graph's depth operator.
            stop_requested: polled between the optimiser steps of a plain recording.
        """
        if self.clock is not None:
            return UntilDisplay(self.clock, depth.background, self.guard)
        if self.session is not None:
            return RecordedCalls(self.session.schedule, self.session.late_depths)
        return EveryFrame(self.held_out, stop_requested)


@dataclass(frozen=True)
class Outputs:
    """Consumers of a run's pictures and scores."""

    sinks: Sequence[str] = ()
    """Names of the sinks that write the run's output, as in `SINKS`."""
    report: bool = True
    """Collect data for a report: per-frame log, SSIM and a digest of the pictures."""
    on_scored: Callable[[ScoredFrame], None] | None = None
    """Called with each scored frame; None for no call."""
    behind: TissueBehindTools | None = None
    """Ground truth of the tissue behind the tools; replays only."""
    on_shown: Callable[[ShownPicture], None] | None = None
    """Called with each picture of the display; live streams only."""
    recorder: SessionRecorder | None = None
    """Recorder of frames, pictures and calls of training; live streams only."""


class Pipeline(Application):
    """Application that composes the operators of a replay or a live run, from the source to the sinks."""

    def __init__(
        self,
        source: FrameSource,
        settings: JobOptions | EngineOptions,
        out: Path,
        *,
        name: str,
        pace: Pace,
        make_reconstructor: Callable[[], Reconstructor],
        outputs: Outputs | None = None,
        rasterizer: Rasterizer | None = None,
        seconds: float | None = None,
        stop_requested: Callable[[], bool] = lambda: False,
    ) -> None:
        """Store the parameters; `compose` creates the operators.

        Args:
            source: source of the frames.
            settings: options of the engine.
            out: output folder.
            name: name of the application.
            pace: timing of the run.
            make_reconstructor: factory of the reconstructor, called at the start of the run.
            outputs: consumers of pictures and scores; None for scores alone.
            rasterizer: warm rasterizer; None to create one.
            seconds: maximum duration of the run; None for no limit.
            stop_requested: polled; True ends the stream.
        """
        super().__init__(name=name, track=True)
        self.frame_source, self.settings, self.out, self.pace = source, settings, out, pace
        self.outputs = outputs or Outputs()
        self._make_reconstructor, self._rasterizer = make_reconstructor, rasterizer
        self._seconds, self._stop_requested = seconds, stop_requested
        self.scheduler(pace.scheduler(settings.device, self))

    def compose(self) -> None:
        """Create and connect the operators (see the diagram of the module)."""
        settings, pace, outputs, about = self.settings, self.pace, self.outputs, self.frame_source.description
        self.source_op = SourceOp(
            self, name="source", source=self.frame_source, stop_requested=self._stop_requested, seconds=self._seconds
        )
        learns = pace.predict_every > 0
        # Frames of a session were analysed when they were recorded. A finished model is displayed and scored with the
        # frames that it was trained on.
        is_analysed = pace.session is not None or not learns
        depth = DepthOp(
            self,
            name="depth",
            choice="recorded" if pace.session is not None else settings.depth,
            camera=about.camera,
            in_background=pace.clock is not None,
            as_recorded=pace.session is not None,
            # A finished model does not use depth.
            has_time=learns and pace.clock is None,
            device=settings.device,
            held_out=pace.held_out,
        )
        analysis = self._analysis(depth, is_analysed)
        self.reconstruct = ReconstructOp(
            self,
            name="reconstruct",
            make_reconstructor=self._make_reconstructor,
            training=pace.training(depth, self._stop_requested),
            recorder=outputs.recorder,
        )
        deform = DeformOp(self, name="deform")
        rasterize = RasterizeOp(
            self,
            name="rasterize",
            renderer=settings.renderer,
            renderer_options=settings.renderer_options,
            outputs=self._shown_outputs,
            predict_every=pace.predict_every,
            rasterizer=self._rasterizer,
        )
        before: Operator = self.source_op
        for operator in analysis:
            self.add_flow(before, operator, {("frame", "frame")})
            before = operator
        self.add_flow(before, self.reconstruct, {("frame", "frame")}, **pace.queue(5))
        self.add_flow(self.reconstruct, deform, {("reconstruction", "reconstruction")}, **pace.queue(2))
        self.add_flow(deform, rasterize, {("scene", "scene")}, **pace.queue(2))
        reserve = StorageReserve(self.out, self.room_to_finish)
        log = FrameLog(self.out / FRAMES_FILE, reserve) if outputs.report else None
        self.metrics = MetricsOp(self, name="metrics", on_screen=pace.clock is not None, log=log, report=outputs.report)
        if pace.clock is None:
            self.add_flow(rasterize, self.metrics, {("rendered", "rendered")})
        else:
            self.add_flow(before, self.metrics, {("frame", "frame")})
            self._show(rasterize, pace.clock)
        if learns:
            self.add_flow(rasterize, self.metrics, {("predicted", "predicted")})
        self._connect_sinks(rasterize, reserve)

    def _analysis(self, depth: DepthOp, is_analysed: bool) -> Sequence[Operator]:
        """Create and return the operators between source and reconstruction, in order."""
        settings, recorder = self.settings, self.outputs.recorder
        choice = "given" if self.pace.session is not None else settings.poses
        poses = pose_operators(self, choice, self.frame_source.description.camera, settings.depth)
        if is_analysed:
            return RecordedToolMaskOp(self, name="tool_mask"), *poses, depth
        return (
            analysis_operator(
                self,
                settings.tool_mask,
                settings.out_of_body,
                (*poses, depth),
                behind_gate=[RecordFramesOp(self, name="recorded_frames", recorder=recorder)] if recorder else [],
                behind=[RecordPreparationOp(self, name="recorded_preparation", recorder=recorder)] if recorder else [],
                device=settings.device,
            ),
        )

    def _show(self, rasterize: RasterizeOp, clock: FrameClock) -> None:
        """Connect the live display and the consumers of its pictures."""
        outputs = self.outputs
        self.display = DisplayOp(
            self,
            name="display",
            clock=clock,
            source_state=lambda: self.source_op.displayed_state,
            guard=self.pace.guard,
        )
        self.add_flow(rasterize, self.display, {("rendered", "rendered")})
        if outputs.recorder is not None:
            pictures = RecordPicturesOp(self, name="recorded_pictures", recorder=outputs.recorder)
            self.add_flow(self.display, pictures, {("shown", "shown")}, **self.pace.queue(8))
        self.add_flow(self.display, self.metrics, {("shown", "shown")})
        if outputs.on_shown is not None:
            viewer = CallbackSinkOp(self, name="viewer", callback=outputs.on_shown)
            self.add_flow(self.display, viewer, {("shown", "message")}, **self.pace.queue(1))

    def _connect_sinks(self, rasterize: RasterizeOp, reserve: StorageReserve) -> None:
        """Connect the sinks. Each consumes either rendered or scored frames."""
        about, outputs = self.frame_source.description, self.outputs
        options = SinkOptions(self.out, about, reserve)
        sinks = [SINKS[name](self, name, options) for name in outputs.sinks]
        if self._shown_outputs:
            folder, names = self.out, self._shown_outputs
            sinks.append(
                OutputVideosOp(self, name="outputs", folder=folder, outputs=names, fps=about.fps, reserve=reserve)
            )
        producers: dict[type, tuple[Operator, str]] = {
            RenderedFrame: (rasterize, "rendered"),
            ScoredFrame: (self.metrics, "scored"),
        }
        for sink in sinks:
            port, kind = input_of(sink)
            producer, output = producers[kind]
            self.add_flow(producer, sink, {(output, port)}, **self.pace.queue(4))
        if self.pace.session is not None:
            compare = CompareShownOp(self, name="compare", shown=self.pace.session.digests)
            self.add_flow(rasterize, compare, {("rendered", "rendered")})
        if outputs.behind is not None and about.frame_count is not None:
            truth = TruthOp(
                self, name="truth", behind=outputs.behind, camera=about.camera, frame_count=about.frame_count
            )
            self.add_flow(rasterize, truth, {("rendered", "rendered")})
        if outputs.on_scored is not None:
            progress = CallbackSinkOp(self, name="progress", callback=outputs.on_scored)
            self.add_flow(self.metrics, progress, {("scored", "message")}, **self.pace.queue(1))

    @property
    def _shown_outputs(self) -> tuple[str, ...]:
        """Outputs that are written as videos."""
        return self.settings.outputs if isinstance(self.settings, OutputSection) else ()

    def room_to_finish(self) -> int:
        """Return the disk space that finishing needs, in bytes: the newest model in float32 and the
        report.
        """
        return REPORT_RESERVE_BYTES + 4 * self.reconstruct.parameter_count


class SideBySideOp(Operator):
    """Runs several chains of operators on each frame in parallel, merges their results, and runs a final chain.

    Each operator of a chain reads a `Frame` at its input `frame` and emits it with more fields at its output `frame`.
    The result is the frame of the chain `first`. It gets the tool mask of the chain `beside` if it has none, and its
    loss mask is intersected with that of `beside`. If the gate withholds the frame, the gate's frame with the number
    and timestamp of `first` is used instead; it passes through the final chain, too.

    The operators belong to no graph. This operator starts and stops them and forwards their contributions to the
    outcome.

    Inputs:
        frame: `Frame`.

    Outputs:
        frame: `Frame`.

    Params:
        gate: chain that may withhold a frame from downstream; the other chains see its picture.
        first: chain whose frame is passed on.
        beside: chain that runs in parallel to `first`; only its tool mask and loss mask are used.
        then: final chain, run on the merged or withheld frame.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        gate: Sequence[Operator],
        first: Sequence[Operator],
        beside: Sequence[Operator] = (),
        then: Sequence[Operator] = (),
        **kwargs: Any,
    ) -> None:
        self.gate, self.first, self.beside, self.then = tuple(gate), tuple(first), tuple(beside), tuple(then)
        self._pool: ThreadPoolExecutor | None = None
        super().__init__(fragment, *args, **kwargs)

    @property
    def parts(self) -> tuple[Operator, ...]:
        """Return the operators of all chains."""
        return (*self.gate, *self.first, *self.beside, *self.then)

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("frame", type=Frame)

    def initialize(self) -> None:
        for operator in self.parts:
            operator.initialize()

    def start(self) -> None:
        self._pool = ThreadPoolExecutor(2, thread_name_prefix=self.name)
        for operator in self.parts:
            operator.start()

    def stop(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        for operator in self.parts:
            operator.stop()

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._pool is not None
        frame: Frame = op_input.receive("frame")
        # Submit the slowest chain first.
        others = [self._pool.submit(through, part, frame) for part in (self.beside, self.gate)]
        try:
            decided = through(self.first, frame)
        finally:
            # Wait for all chains even if the first one raises, so that none overlaps with the next
            # frame.
            for other in others:
                other.exception()
        found, gated = [other.result() for other in others]
        if gated.withheld is None:
            decided = with_findings(decided, found)
        else:
            decided = gated.with_fields(seq=decided.seq, pts_ns=decided.pts_ns)
        op_output.emit(through(self.then, decided), "frame")

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the results of the operators of all chains to the outcome of the run."""
        for operator in self.parts:
            if isinstance(operator, Contributor):
                operator.contribute(outcome)


def with_findings(decided: Frame, found: Frame) -> Frame:
    """Merge the frames of two chains.

    Args:
        decided: frame whose fields take precedence.
        found: frame that supplies the tool mask if `decided` has none. The loss masks are intersected.
    """
    added = {"mask": found.mask} if decided.mask is None else {}
    if found.loss_mask is not None:
        own = decided.loss_mask
        added["loss_mask"] = found.loss_mask if own is None else np.minimum(own, found.loss_mask)
    return decided.with_fields(**added)


def through(operators: Sequence[Operator], frame: Frame) -> Frame:
    """Run the operators of a chain on a frame, in order, and return the resulting frame."""
    for operator in operators:
        port: Any = _Passing(frame)
        operator.metadata = {}
        operator.compute(port, port, port)
        frame = port.frame
    return frame


class _Passing:
    """Input and output port of one operator in a chain."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame

    def receive(self, name: str) -> Frame:
        return self.frame

    def emit(self, frame: Frame, name: str) -> None:
        self.frame = frame
