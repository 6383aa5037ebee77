"""Operator for online reconstruction: owns the model, warms it up, trains it on arriving frames and hands out copies on request."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.choices import Eyes
from gsplat_core.models import Model, Snapshot
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget
from operators.graph import Operator, OperatorSpec
from operators.messages import Reconstruction
from operators.outcome import OutcomeBuilder
from operators.sinks.session_recorder import SessionRecorder
from operators.training import Learner, Training, TrainingCounts

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ModelAnswer:
    """Answer to a `ModelRequest`: the model with its deformable past, after training on the given frame."""

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
            model: the model with its deformable past.
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
    """Outcome part with the final model of a run."""

    model: Model
    """Newest version of the model, copied so that no later call changes it."""


@dataclass(frozen=True)
class TrainedEyes:
    """Outcome part: the eyes of a stereo endoscope whose pictures the model was trained on."""

    eyes: Eyes


class ReconstructOp(Operator):
    """Trains on each frame, then publishes the model, so that a frame's picture includes its own
    training.

    Withheld and damaged frames are passed on with the current model and not trained on, except those that the model
    follows (`Frame.is_followed`). A new scene (`Frame.new_scene`, a changed scene number or picture size) starts a new
    model. Unusable frames before the first model of a scene are dropped.

    Inputs:
        frame: `Frame`.

    Outputs:
        reconstruction: `Reconstruction` with an immutable `Model`, or a `Snapshot` on a GPU.

    Params:
        make_reconstructor: factory called in `start()`; the operator owns the result exclusively.
        training: decides how much each frame is trained on, and when.
        recorder: receives every call that changes the model, in order, so that the run can be
            replayed; None for no recording.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        make_reconstructor: Callable[[], Reconstructor],
        training: Training,
        recorder: SessionRecorder | None = None,
        **kwargs: Any,
    ) -> None:
        self.make_reconstructor, self.training, self.recorder = make_reconstructor, training, recorder
        self.model: Model | None = None
        """Newest model with its past, as an independent copy; set when the run has ended."""
        self.counts = TrainingCounts()
        self._learner: Learner | None = None
        self._requests: deque[ModelRequest] = deque()
        self._eyes: Eyes = "left"
        super().__init__(fragment, *args, **kwargs)

    @property
    def newest(self) -> Model | Snapshot | None:
        """Last published model, for display; None before the first one."""
        learner = self._learner
        return self.model if learner is None else learner.newest

    @property
    def parameter_count(self) -> int:
        """Number of values in all tensors of the complete model, which is saved at the end of the run."""
        learner = self._learner
        kept = self.model if learner is None else learner.reconstructor
        return 0 if kept is None else kept.parameter_count

    @property
    def newest_gaussians(self) -> int:
        """Number of Gaussians in the last published model."""
        newest = self.newest
        if newest is None:
            return 0
        return newest.gaussians.count if isinstance(newest, Model) else newest.gaussian_count

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("frame", type=Frame)
        spec.output("reconstruction", type=Reconstruction)

    def start(self) -> None:
        self.counts, self.model = TrainingCounts(), None
        self.training.begin()
        self._learner = Learner(self.make_reconstructor, self.recorder, self.counts)

    def prepare_thread(self) -> None:
        """Initialise cuBLAS in this thread. The first matrix product in a thread takes longer than
        a frame interval.
        """
        assert self._learner is not None
        one = torch.ones(1, 1, device=self._learner.reconstructor.device)
        torch.mm(one, one)

    def stop(self) -> None:
        # Free the optimiser state and the snapshot slots; keep the last model for saving.
        if self._learner is not None:
            self.model = self._learner.whole_model()
            self._eyes = self._learner.reconstructor.eyes.trained
        self._learner = None
        self.training.end()
        while self._requests:
            self._requests.popleft().refuse("the reconstruction has ended")

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        assert self._learner is not None
        frame = self.training.take(op_input, self._learner)

        def frame_waits() -> bool:
            return bool(op_input.queued("frame"))

        reconstruction = self.training.learn(frame, self._learner, frame_waits)
        if reconstruction is None:
            return
        op_output.emit(reconstruction, "reconstruction")
        self._answer_requests(frame, self._learner)
        self.training.rest(frame, self._learner, frame_waits)

    def request_model(self) -> ModelRequest:
        """Request the model with its deformable past, after the next frame. Thread-safe."""
        request = ModelRequest()
        self._requests.append(request)
        return request

    def _answer_requests(self, frame: Frame, learner: Learner) -> None:
        """Answer pending model requests. Called after the frame was emitted, so that copying the model delays only
        rehearsal.
        """
        while self._requests:
            assert learner.newest is not None
            began_ns = time.perf_counter_ns()
            # A GPU snapshot is complete and immutable while held. The requester copies it in its
            # own thread.
            request, newest = self._requests.popleft(), learner.newest
            try:
                model = newest if isinstance(newest, Snapshot) else learner.reconstructor.whole_model(newest)
            except Exception as error:  # refuse the request; the stream must continue
                log.exception("the whole model was not copied")
                request.refuse(f"{type(error).__name__}: {error}")
                continue
            request.answer(model, frame, time.perf_counter_ns() - began_ns)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the final model and the statistics of its training to the outcome of the run."""
        counts = self.counts
        outcome.add(TrainedEyes(self._eyes))
        outcome.add(replace(counts, withheld=dict(counts.withheld), scenes=dict(counts.scenes)))
        self.training.contribute(outcome, counts)
        if self.model is not None:
            outcome.add(ModelResult(self.model))


WARM_FRAMES = 4
WARM_STEPS = {"cpu": 3, "cuda": 40}
"""Optimiser steps on each warm-up picture."""
EYES_APART = 0.07
"""Stereo baseline of the warm-up as a share of the scene's distance."""


def warm_reconstructor(
    reconstructor: Reconstructor,
    draw: Callable[[Frame, Model | Snapshot], object] = lambda *_: None,
    *,
    stereo: bool = False,
) -> None:
    """Train on noise and reset the model, so that all one-time initialisation is done.

    A replay of a recorded session performs the same warm-up. On a GPU, noise enlarges the tile
    lists, whose capacity determines which steps are repeated.

    Args:
        reconstructor: the new reconstructor.
        draw: called with each warm-up frame and its model.
        stereo: include pictures of a right eye.
    """
    image = noise(reconstructor.camera)
    height, width = image.shape[:2]
    tissue = np.ones((height, width), np.uint8)
    tissue[height // 2 :, : width // 2] = 0  # a tool, so that the code for hidden tissue runs, too
    depth = np.full((height, width), reconstructor.config.default_depth_mm, np.float32)
    drawn: list[object] = []
    for frames in (WARM_FRAMES, 1):  # the second scene runs the code that reuses memory
        for seq in range(frames):
            frame = Frame(seq, seq * 33_000_000, image, mask=tissue)
            if stereo:
                right = reconstructor.camera.right_eye(EYES_APART * reconstructor.config.default_depth_mm)
                frame = frame.with_fields(right_image=image, right_camera=right)
            # A time budget makes the reconstructor measure the duration of an optimiser step.
            reconstructor.observe(frame, budget=Budget.until(0.0, at_least=WARM_STEPS[reconstructor.device.type]))
            # All models are held, so that every snapshot slot and pinned buffer of a run is
            # allocated.
            model = reconstructor.publish()
            drawn.append((model, draw(frame, model)))
            # Steps with depth are captured as a separate graph.
            reconstructor.take_depth(frame.with_fields(depth=depth))
            reconstructor.rehearse(2)
            reconstructor.grow(frame)
        reconstructor.grow_once()
        reconstructor.forget()


def noise(camera: Camera) -> NDArray[np.uint8]:
    """Return a picture of uniform noise of the camera's size, uint8 RGB [H, W, 3]."""
    return np.random.default_rng(0).integers(0, 256, (camera.height_px, camera.width_px, 3), np.uint8)
