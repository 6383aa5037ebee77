"""Operators for online reconstruction: each owns the model and trains it on arriving frames.

`ReconstructOp` trains a number of steps per frame, `LiveReconstructOp` until the display deadline, and `ScheduledReconstructOp` repeats the recorded calls of
a live session, which reproduces its model.

Operator for online reconstruction of a live stream against display deadlines.

Each frame is trained on until its deadline. Spare time until the next frame is spent on rehearsal.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch

from gsplat_core.choices import Eyes
from gsplat_core.io.sessions.records import (
    DepthTaken,
    Grown,
    LostLine,
    Observed,
    ReconstructorMade,
    Rehearsed,
    SceneBegun,
    ScheduleLine,
)
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.placement import MOST_LATE
from gsplat_core.training.reconstructor import Reconstructor
from operators.depth import DepthFound, LateDepths
from operators.frame_clock import FrameClock
from operators.graph import Operator, OperatorSpec
from operators.messages import Reconstruction
from operators.outcome import OutcomeBuilder


@dataclass(frozen=True)
class ScheduleEvent:
    """One call of the reconstructor."""

    kind: Literal["begin_scene", "observe", "take_depth", "grow", "rehearse"]
    seq: int | None = None
    """Sequence number of the frame argument; None for rehearsal."""
    frame: Frame | None = None
    """The frame with its depth, for `take_depth`."""
    steps: int = 0
    """Optimiser steps on the newest frame (`observe`) or on the window (`rehearse`)."""
    train: bool = True
    """False for a frame that was displayed but not trained on."""


ScheduleListener = Callable[[ScheduleEvent], None]


@dataclass(frozen=True)
class ModelAnswer:
    """The whole model as of a given frame."""

    model: Model | Snapshot
    frame: Frame
    pause_ns: int
    """Time for which training paused to copy the model, in nanoseconds."""


class ModelRequest:
    """Future of a model: the training thread answers or refuses, the requesting thread waits."""

    def __init__(self) -> None:
        self._answered = threading.Event()
        self._answer: ModelAnswer | None = None
        self.refused = ""
        """Reason for the refusal; empty unless refused."""

    def answer(self, model: Model | Snapshot, frame: Frame, pause_ns: int) -> None:
        """Complete the request with a model.

        Args:
            model: the whole model.
            frame: newest frame that the model includes.
            pause_ns: time for which training paused, in nanoseconds.
        """
        self._answer = ModelAnswer(model, frame, pause_ns)
        self._answered.set()

    def refuse(self, why: str) -> None:
        """Complete the request without a model; `why` is the reason for the user."""
        self.refused = why
        self._answered.set()

    def wait(self, timeout_s: float) -> ModelAnswer | None:
        """Wait for the answer. Return None if the request was refused or `timeout_s` seconds
        elapsed.
        """
        self._answered.wait(timeout_s)
        return self._answer


@dataclass(frozen=True)
class ModelResult:
    """Final model of a run."""

    model: Model
    """Newest version, as an independent copy."""


@dataclass(frozen=True)
class TrainedEyes:
    """Cameras of a stereo scope whose pictures the model was trained on."""

    eyes: Eyes


def never_held_out(frame: Frame) -> bool:
    """Return False: all frames are trained on."""
    return False


class ReconstructOp(Operator):
    """Trains on each frame, then publishes the model, so that a frame's picture includes its own
    training.

    Inputs:
        frame: `Frame`.

    Outputs:
        reconstruction: `Reconstruction` with an immutable `Model`, or a `Snapshot` on a GPU.

    Params:
        make_reconstructor: factory called in `start()`; the operator owns the result exclusively.
        held_out: returns True for frames to exclude from training. Such frames, and damaged or
            withheld ones, are passed on with the newest model. Withheld frames before the first
            model are dropped.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        make_reconstructor: Callable[[], Reconstructor],
        held_out: Callable[[Frame], bool] = never_held_out,
        **kwargs: Any,
    ) -> None:
        self.make_reconstructor = make_reconstructor
        self.held_out = held_out
        self.newest: Model | Snapshot | None = None
        """Last published model or snapshot."""
        self._reconstructor: Reconstructor | None = None
        self._eyes: Eyes = "left"
        super().__init__(fragment, *args, **kwargs)

    @property
    def model(self) -> Model | None:
        """Last published model as an independent copy; on a GPU it is copied on access."""
        return None if self.newest is None else self.newest.as_model()

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("reconstruction", type=Reconstruction)

    def start(self) -> None:
        self._reconstructor = self.make_reconstructor()
        self.newest = None

    def stop(self) -> None:
        # Free the optimiser state and the slots; keep the last model for saving.
        self.newest = self.model
        if self._reconstructor is not None:
            self._eyes = self._reconstructor.eyes.trained
        self._reconstructor = None

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._reconstructor is not None
        frame = op_input.receive("frame")
        if self.newest is None and frame.withheld is not None:
            return  # no model exists to show the frame, and a withheld frame must not start one
        # The first frame is always trained on, because a held-out frame needs a model.
        kept_out = frame.status is FrameStatus.DAMAGED or frame.withheld is not None or self.held_out(frame)
        train = self.newest is None or not kept_out
        report = self._reconstructor.observe(frame, train=train)
        # A held-out frame changes no parameters but extends the model's time window.
        self.newest = self._reconstructor.publish()
        op_output.emit(
            Reconstruction(frame, self.newest, trained=train, steps=report.steps, arriving_loss=report.arriving_loss),
            "reconstruction",
        )

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        outcome.add(TrainedEyes(self._eyes))
        model = self.model
        if model is not None:
            outcome.add(ModelResult(model))


log = logging.getLogger(__name__)
REHEARSED_AT_ONCE = 3
"""Rehearsal steps on a GPU between two checks for a new frame. On the slower CPU it is one step."""
GROWN_AT_LATEST = 10
"""Maximum number of trained frames between two growth steps; beyond it growth runs even without
spare time.
"""
WAITING = 5
"""Capacity of the input queue, in frames; if it is full, the oldest frame is dropped."""


@dataclass
class TrainingCounts:
    """Statistics of live training."""

    frames: int = 0
    """Number of frames that were trained on."""
    steps: int = 0
    """Optimiser steps on the newest frame before its display."""
    passed_over: int = 0
    """Frames dropped for newer ones."""
    rehearsed: int = 0
    """Rehearsal steps, on frames of the training window."""
    withheld: dict[str, int] = field(default_factory=dict)
    """Frames excluded from training (withheld or damaged), by reason."""
    scenes: dict[str, int] = field(default_factory=dict)
    """Number of scene restarts, by reason."""
    places_found: int = 0
    """New scenes recognised as a place that the stream had shown before."""


class LiveReconstructOp(Operator):
    """Trains on each frame until its display deadline, publishes the model, and rehearses until the
    next frame.

    Withheld and damaged frames are shown with the current model and not trained on. A new scene
    (`Frame.new_scene`, a changed scene number or picture size) starts a new model.

    Inputs:
        frame: `Frame`; frames that are too late are dropped.

    Outputs:
        reconstruction: `Reconstruction`.

    Params:
        make_reconstructor: factory called in `start()`; the operator owns the result exclusively.
        clock: display deadlines and training budgets.
        listener: called with every call that changes the model, in order, so that a run can be
            replayed.
        depth: asynchronous depth estimator for the trained frames; None disables late depth.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        make_reconstructor: Callable[[], Reconstructor],
        clock: FrameClock,
        listener: ScheduleListener | None = None,
        depth: DepthFound | None = None,
        **kwargs: Any,
    ) -> None:
        self.make_reconstructor = make_reconstructor
        self.clock = clock
        self.listener = listener
        self._late_depths = LateDepths(depth)
        self.newest: Model | Snapshot | None = None
        """Last published model, for display."""
        self.model: Model | None = None
        """Newest model including archived parts; set when the run has ended."""
        self.counts = TrainingCounts()
        self._reconstructor: Reconstructor | None = None
        self._learned: Frame | None = None
        """Newest frame that the model was trained on."""
        self._scene = 0
        """Number of the scene that the model represents."""
        self._requests: deque[ModelRequest] = deque()
        self._eyes: Eyes = "left"
        self._since_grown = 0
        """Frames trained on since the last growth step."""
        super().__init__(fragment, *args, **kwargs)

    @property
    def parameter_count(self) -> int:
        """Number of values in all tensors of the whole model, which is saved at the end of the
        run.
        """
        kept = self._reconstructor or self.model
        return 0 if kept is None else kept.parameter_count

    @property
    def newest_gaussians(self) -> int:
        """Number of Gaussians in the last published model."""
        newest = self.newest
        if newest is None:
            return 0
        return newest.gaussians.count if isinstance(newest, Model) else newest.gaussian_count

    def setup(self, spec: OperatorSpec) -> None:
        port = spec.input("frame", policy="drop_oldest", type=Frame)
        port.connector(port.ConnectorType.DEFAULT, capacity=WAITING)
        spec.output("reconstruction", type=Reconstruction)

    def start(self) -> None:
        self.counts, self.newest, self.model, self._learned = TrainingCounts(), None, None, None
        self._scene = self._since_grown = 0
        self._late_depths.begin()
        self._reconstructor = self.make_reconstructor()

    def prepare_thread(self) -> None:
        """Initialise cuBLAS in this thread. The first matrix product in a thread takes longer than
        a frame interval.
        """
        assert self._reconstructor is not None
        one = torch.ones(1, 1, device=self._reconstructor.device)
        torch.mm(one, one)

    def stop(self) -> None:
        if self.newest is not None and self._reconstructor is not None:
            self.model = self._reconstructor.whole_model(self.newest)
        if self._reconstructor is not None:
            self._eyes = self._reconstructor.eyes.trained
        self.newest = self.model
        self._reconstructor = self._learned = None
        while self._requests:
            self._requests.popleft().refuse("the reconstruction has ended")

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        while (waiting := op_input.queued("frame")) and self.clock.too_late(frame, waiting):
            self.counts.passed_over += 1
            frame = op_input.receive("frame")
        reconstruction = self._observe(frame, behind=bool(op_input.queued("frame")))
        if reconstruction is not None:
            op_output.emit(reconstruction, "reconstruction")
            self._answer_requests(frame)
            if not op_input.queued("frame"):
                self.clock.wait_until_shown()
            self._take_depth()
            self._rehearse(frame, lambda: bool(op_input.queued("frame")))

    def _observe(self, frame: Frame, behind: bool) -> Reconstruction | None:
        assert self._reconstructor is not None
        taken_ns = self.clock.now_ns()
        reason = self._why_not(frame)
        if reason is not None:
            self.counts.withheld[reason] = self.counts.withheld.get(reason, 0) + 1
        camera = self._reconstructor.camera
        resized = (frame.width_px, frame.height_px) != (camera.width_px, camera.height_px)
        # The scene number changes even if the first frame of the scene was dropped or withheld.
        other_scene = frame.new_scene is not None or frame.scene != self._scene
        if self.newest is None or resized or other_scene:
            if reason is not None:
                return None  # an unusable frame cannot start a scene, and no model exists to show it
            if self.newest is not None:
                self._begin_scene(
                    frame, "resized" if resized else frame.new_scene or "begun by a frame that was not used"
                )
            self._scene = frame.scene
        first = self.newest is None
        if reason is None:
            self._late_depths.offer(frame)
        report = self._reconstructor.observe(
            frame, budget=self.clock.budget(frame, first=first, behind=behind), train=reason is None
        )
        if reason is None:
            self._learned = frame
            self.counts.frames += 1
            self.counts.steps += report.steps
            # The initialisation of a scene already covers its first frame.
            self._since_grown = 0 if first else self._since_grown + 1
        self._tell(ScheduleEvent("observe", seq=frame.seq, steps=report.steps, train=reason is None))
        self.newest = self._reconstructor.publish()
        published_ns = self.clock.now_ns()
        if not first:
            self.clock.published(taken_ns, published_ns, report.steps, self._reconstructor.step_ns)
        return Reconstruction(
            frame,
            self.newest,
            trained=reason is None,
            steps=report.steps,
            arriving_loss=report.arriving_loss,
            content=self._learned,
            taken_ns=taken_ns,
            published_ns=published_ns,
        )

    def _begin_scene(self, frame: Frame, reason: str) -> None:
        assert self._reconstructor is not None
        self.counts.scenes[reason] = self.counts.scenes.get(reason, 0) + 1
        self.counts.places_found += self._reconstructor.begin_scene(frame)
        self._tell(ScheduleEvent("begin_scene", seq=frame.seq))
        self.newest = None

    def _take_depth(self) -> None:
        """Pass depth maps that the background thread has finished to the model. They belong to frames that were
        trained on without depth.
        """
        assert self._reconstructor is not None
        taken = self._late_depths.give(self._reconstructor, self.clock.now_ns)
        if taken is not None:
            self._tell(ScheduleEvent("take_depth", seq=taken.seq, frame=taken))

    def _rehearse(self, frame: Frame, frame_waits: Callable[[], bool]) -> None:
        """Grow the scene if due, then train on the window until the next frame waits or is
        expected.
        """
        assert self._reconstructor is not None
        at_once = REHEARSED_AT_ONCE if self._reconstructor.device.type == "cuda" else 1
        made = 0

        def has_time() -> bool:
            assert self._reconstructor is not None
            return not frame_waits() and self.clock.may_rehearse(made, self._reconstructor.rehearsal_ns(at_once))

        if frame is self._learned and self._since_grown and (self._since_grown >= GROWN_AT_LATEST or has_time()):
            self._reconstructor.grow(frame)
            self._tell(ScheduleEvent("grow", seq=frame.seq))
            self._since_grown = 0
        while has_time():
            self._reconstructor.rehearse(at_once)
            made += at_once
        self.counts.rehearsed += made
        if made:
            self._tell(ScheduleEvent("rehearse", steps=made))

    def _why_not(self, frame: Frame) -> str | None:
        if frame.withheld is not None:
            return frame.withheld
        return "damaged" if frame.status is FrameStatus.DAMAGED else None

    def _tell(self, event: ScheduleEvent) -> None:
        if self.listener is not None:
            self.listener(event)

    def request_model(self) -> ModelRequest:
        """Request the whole model as of the next frame. Thread-safe."""
        request = ModelRequest()
        self._requests.append(request)
        return request

    def _answer_requests(self, frame: Frame) -> None:
        """Answer pending model requests after the picture was emitted, so that the work only delays
        rehearsal.
        """
        while self._requests:
            assert self._reconstructor is not None and self.newest is not None
            began_ns = time.perf_counter_ns()
            # A GPU snapshot is complete and immutable while held. The requester copies it in its
            # own thread.
            request, newest = self._requests.popleft(), self.newest
            try:
                model = newest if isinstance(newest, Snapshot) else self._reconstructor.whole_model(newest)
            except Exception as error:  # reported to the requester; the stream continues
                log.exception("the whole model was not copied")
                request.refuse(f"{type(error).__name__}: {error}")
                continue
            request.answer(model, frame, time.perf_counter_ns() - began_ns)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        counts = self.counts
        outcome.add(TrainedEyes(self._eyes))
        outcome.add(replace(counts, withheld=dict(counts.withheld), scenes=dict(counts.scenes)))
        self._late_depths.contribute(outcome)
        if self.model is not None:
            outcome.add(ModelResult(self.model))


class ScheduledReconstructOp(ReconstructOp):
    """`ReconstructOp` that repeats the recorded calls of a `Reconstructor`.

    Frames that the session dropped produce no output.

    Params:
        make_reconstructor: factory called wherever the schedule records a new reconstructor.
        schedule: called in `start()`; yields the lines of the schedule from the beginning.
        late_depths: called in `start()`; yields the frame fields for each `take_depth` line, in
            order.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        make_reconstructor: Callable[[], Reconstructor],
        schedule: Callable[[], Iterator[ScheduleLine | LostLine]],
        late_depths: Callable[[], Iterator[dict[str, Any] | None]],
        **kwargs: Any,
    ) -> None:
        self.make_live, self.schedule, self.late_depths = make_reconstructor, schedule, late_depths
        self.missing: int | None = None
        """Sequence number of the first recorded frame, or late depth, that is missing; later
        pictures may differ. None if complete.
        """
        self._lines: Iterator[ScheduleLine | LostLine] = iter(())
        self._depths: Iterator[dict[str, Any] | None] = iter(())
        self._due: ScheduleLine | LostLine | None = None
        self._live: Reconstructor | None = None
        self._observed: OrderedDict[int, Frame] = OrderedDict()
        """The most recently observed frames, by sequence number."""
        super().__init__(fragment, *args, make_reconstructor=make_reconstructor, **kwargs)

    def start(self) -> None:
        self.newest = self.missing = self._live = None
        self._observed.clear()
        self._lines, self._depths = self.schedule(), self.late_depths()
        self._due = next(self._lines, None)

    def stop(self) -> None:
        if self.newest is not None and self._live is not None:
            self.newest = self._live.whole_model(self.newest)
        super().stop()
        if self._live is not None:
            self._eyes = self._live.eyes.trained
        self._live = None
        self._observed.clear()
        self._lines, self._depths = iter(()), iter(())

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        observed = self._follow_to(frame)
        if observed is None or self._live is None:
            return
        train = observed.train and frame.status is not FrameStatus.DAMAGED
        if self.newest is None and not train:
            return
        self._observed[frame.seq] = frame
        while len(self._observed) > MOST_LATE:
            self._observed.popitem(last=False)
        report = self._live.observe(frame, steps=observed.steps, train=train)
        self.newest = self._live.publish()
        op_output.emit(
            Reconstruction(frame, self.newest, trained=train, steps=report.steps, arriving_loss=report.arriving_loss),
            "reconstruction",
        )

    def _follow_to(self, frame: Frame) -> Observed | None:
        """Replay the calls that precede this frame's observation. Return its line; None if it was
        never observed.
        """
        while self._due is not None:
            line = self._due
            if isinstance(line, Observed | SceneBegun) and line.seq > frame.seq:
                return None
            self._due = next(self._lines, None)
            if isinstance(line, Observed):
                if line.seq == frame.seq:
                    return line
                self._miss(line.seq)
            elif isinstance(line, ReconstructorMade):
                self._live, self.newest = self.make_live(), None
            elif isinstance(line, DepthTaken | LostLine):
                self._take_depth(line)
            elif self._live is not None:
                self._call(self._live, line, frame)
        return None

    def _call(self, live: Reconstructor, line: SceneBegun | Grown | Rehearsed, frame: Frame) -> None:
        """Replay one call that precedes the observation of `frame`."""
        if isinstance(line, Rehearsed):
            if live.gaussians:
                live.rehearse(line.steps)
        elif isinstance(line, Grown):
            if self._observed and line.seq == next(reversed(self._observed)):
                live.grow(self._observed[line.seq])
        elif line.seq == frame.seq:
            live.begin_scene(frame)
            self.newest = None

    def _take_depth(self, line: DepthTaken | LostLine) -> None:
        """Replay a late depth estimate, or note that the frame or depth is missing."""
        fields = next(self._depths, None) if isinstance(line, DepthTaken) else None
        frame = self._observed.get(line.seq)
        if fields is None or frame is None or self._live is None:
            self._miss(line.seq)
        else:
            self._live.take_depth(frame.with_fields(**fields))

    def _miss(self, seq: int) -> None:
        self.missing = seq if self.missing is None else self.missing

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        super().contribute(outcome)
        if self.missing is not None:
            outcome.note(
                f"frame {self.missing} was trained on in the session and is not in its recording, or its depth is not: later pictures may differ"
            )
