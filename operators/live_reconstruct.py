"""Operator for online reconstruction of a live stream against display deadlines.

Each frame is trained on until its deadline. Spare time until the next frame is spent on rehearsal.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from gsplat_core.choices import Eyes
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.live import LiveReconstructor
from operators.frame_clock import FrameClock
from operators.graph import Operator, OperatorSpec
from operators.late_depth import DepthFound, LateDepths
from operators.messages import Reconstruction
from operators.model_request import ModelRequest
from operators.outcome import OutcomeBuilder
from operators.reconstruct import ModelResult, TrainedEyes
from operators.schedule import ScheduleEvent, ScheduleListener

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
        make_reconstructor: Callable[[], LiveReconstructor],
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
        self._reconstructor: LiveReconstructor | None = None
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
        """Pass depth estimated in the meantime to the model, for a frame trained on earlier."""
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
