"""Training policies: the number of optimiser steps on each frame, and the work between two frames.

`ReconstructOp` owns a `Learner` and delegates these decisions to a `Training`. `EveryFrame` trains a number of steps on each frame. `UntilDisplay` trains
until the display deadline, and on earlier frames until the next frame arrives. `RecordedCalls` repeats the calls of a recorded session.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

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
from gsplat_core.models import Model, Snapshot
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.placement import MOST_LATE, LateDepth
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget
from operators.depth import BackgroundDepth, TakenDepth
from operators.frame_clock import BehindGuard, FrameClock
from operators.graph.tracking import Histogram
from operators.messages import Reconstruction
from operators.outcome import OutcomeBuilder
from operators.sinks.session_recorder import SessionRecorder

REHEARSED_AT_ONCE = 3
"""Number of rehearsal steps (optimiser steps on earlier frames) on a GPU between two checks for a new frame; 1 on a CPU."""
GROWN_AT_LATEST = 10
"""Maximum number of trained frames between two growth steps, which create and archive Gaussians. Beyond it a growth step runs even
without spare time."""


@dataclass
class TrainingCounts:
    """Statistics of the training of a run."""

    frames: int = 0
    """Number of frames trained on, including withheld frames that are trained on nevertheless (`Frame.is_followed`)."""
    steps: int = 0
    """Total number of optimiser steps on frames before their display, without rehearsal."""
    passed_over: int = 0
    """Number of frames dropped in favour of newer ones."""
    rehearsed: int = 0
    """Number of rehearsal steps, which train on earlier frames of the training window."""
    withheld: dict[str, int] = field(default_factory=dict)
    """Number of withheld and damaged frames, by reason, including withheld frames trained on nevertheless (`Frame.is_followed`)."""
    withheld_now: dict[str, int] = field(default_factory=dict)
    """Number of withheld and damaged frames since the last usable one, by reason."""
    scenes: dict[str, int] = field(default_factory=dict)
    """Number of times that the model was restarted for a new scene, by reason."""
    renewed: int = 0
    """Number of times that the model of a scene fell behind and was started anew."""
    places_found: int = 0
    """Number of new scenes whose tissue was recognised from an earlier scene of the stream."""


class Learner:
    """Owner of a run's reconstructor and of its last published model.

    Counts the calls that change the model and passes each to the recorder of the session, so that
    the run can be replayed.
    """

    def __init__(
        self,
        make: Callable[[], Reconstructor],
        recorder: SessionRecorder | None = None,
        counts: TrainingCounts | None = None,
    ) -> None:
        self._make, self._recorder = make, recorder
        self.counts = counts or TrainingCounts()
        self.newest: Model | Snapshot | None = None
        """Last published model of the current scene; None before its first frame."""
        self.learned: Frame | None = None
        """Newest frame that the model was trained on."""
        self._scene = 0
        """Scene number (`Frame.scene`) of the frames that the model represents."""
        self.reconstructor = make()

    def renew(self) -> None:
        """Replace the reconstructor by a new, untrained one, and discard the published model."""
        self.reconstructor, self.newest = self._make(), None

    def accepts(self, frame: Frame) -> bool:
        """Return True if a frame is usable. Counts the reason if not."""
        reason = frame.unusable
        if reason is None:
            self.counts.withheld_now = {}
            return True
        self.counts.withheld[reason] = self.counts.withheld.get(reason, 0) + 1
        self.counts.withheld_now = {**self.counts.withheld_now, reason: self.counts.withheld_now.get(reason, 0) + 1}
        return False

    def enter(self, frame: Frame, *, usable: bool) -> bool:
        """Restart the reconstructor's scene if the frame belongs to another scene or has another size.

        The scene number changes even if the first frame of a scene was dropped or withheld.

        Returns:
            False if the frame cannot be shown: it is unusable, and no model of its scene exists.
        """
        camera = self.reconstructor.camera
        resized = (frame.width_px, frame.height_px) != (camera.width_px, camera.height_px)
        other_scene = frame.new_scene is not None or frame.scene != self._scene
        if self.newest is None or resized or other_scene:
            if not usable:
                return False
            if self.newest is not None:
                reason = "resized" if resized else frame.new_scene or "begun by a frame that was not used"
                self.counts.scenes[reason] = self.counts.scenes.get(reason, 0) + 1
                self.begin_scene(frame)
            self._scene = frame.scene
        return True

    def begin_scene(self, frame: Frame, *, anew: bool = False) -> None:
        """Start a new scene in the reconstructor with its first frame `frame`, and clear the published model. With
        `anew` it is the same scene, whose model fell behind.
        """
        if anew:
            self.reconstructor.begin_scene(frame, anew=True)
            self.counts.renewed += 1
        else:
            self.counts.places_found += self.reconstructor.begin_scene(frame)
        self._record(lambda: SceneBegun(seq=frame.seq, anew=anew))
        self.newest = None

    def observe(
        self,
        frame: Frame,
        *,
        budget: Budget | None = None,
        train: bool,
        stop_requested: Callable[[], bool] | None = None,
    ) -> Reconstruction:
        """Process the next frame, train on it if `train` is True, and publish the model. Arguments as for
        `Reconstructor.observe`."""
        doubtful = frame.unusable is not None
        report = self.reconstructor.observe(
            frame, budget=budget, train=train, doubtful=doubtful, stop_requested=stop_requested
        )
        if train:
            self.learned = frame
            self.counts.frames += 1
            self.counts.steps += report.steps
        self._record(lambda: Observed(seq=frame.seq, steps=report.steps, train=train))
        self.newest = self.reconstructor.publish()
        return Reconstruction(
            frame,
            self.newest,
            trained=train,
            steps=report.steps,
            arriving_loss=report.arriving_loss,
            content=self.learned if doubtful else frame,
        )

    def take_depth(self, frame: Frame, late: LateDepth | None = None) -> bool:
        """Pass late depth to the model, of a frame that was trained on without depth. Return False if the model
        rejects it."""
        taken = self.reconstructor.take_depth(frame, late)
        if taken and self._recorder is not None:
            self._recorder.depth(frame)
        return taken

    def grow(self, frame: Frame) -> None:
        """Run a growth step of the model, which creates, archives or restores Gaussians. `frame` is the newest trained frame, already
        displayed."""
        self.reconstructor.grow(frame)
        self._record(lambda: Grown(seq=frame.seq))

    def record_rehearsal(self, steps: int) -> None:
        """Count the rehearsal steps (optimiser steps on earlier frames) since the last frame, and record them for a replay."""
        self.counts.rehearsed += steps
        if steps:
            self._record(lambda: Rehearsed(steps=steps))

    def whole_model(self) -> Model | None:
        """Return the model with its deformable past and the errors of its depth, as an independent copy; None before the first
        publication.
        """
        if self.newest is None:
            return None
        return self.reconstructor.with_depth_errors(self.reconstructor.whole_model(self.newest))

    def _record(self, line: Callable[[], ScheduleLine]) -> None:
        if self._recorder is not None:
            self._recorder.line(line())


class Training(ABC):
    """Policy that decides how many optimiser steps the model is trained on each frame, and what is done between frames."""

    def begin(self) -> None:  # noqa: B027 - stateless policies do not override it
        """Prepare the policy for a new stream."""

    def end(self) -> None:  # noqa: B027
        """Discard what the policy keeps of a stream."""

    def take(self, op_input: Any, learner: Learner) -> Frame:
        """Take the next frame from the queue of the input `frame`. A policy may drop frames."""
        frame: Frame = op_input.receive("frame")
        return frame

    @abstractmethod
    def learn(self, frame: Frame, learner: Learner, frame_waits: Callable[[], bool]) -> Reconstruction | None:
        """Train the model on a frame, as the policy decides.

        Args:
            frame: next frame in order.
            learner: owner of the model.
            frame_waits: returns True if a further frame is queued.

        Returns:
            The frame with the published model; None if the frame is not displayed.
        """

    def rest(self, frame: Frame, learner: Learner, frame_waits: Callable[[], bool]) -> None:  # noqa: B027
        """Use the time between the publication of the frame's model and the next frame, for example to train on earlier frames.
        Arguments as for `learn`."""

    def contribute(self, outcome: OutcomeBuilder, counts: TrainingCounts) -> None:  # noqa: B027
        """Add the policy's results and notes to the outcome of the run. `counts` are the statistics of the run's learner."""


class EveryFrame(Training):
    """Trains the configured number of optimiser steps on each frame.

    Damaged, withheld and held-out frames are displayed with the newest model and not trained on, except blurred frames
    and possible cuts (`Frame.is_followed`). The first frame of a scene is trained on even if it is held out, because the
    following frames need a model.
    """

    def __init__(
        self,
        held_out: Callable[[Frame], bool] = lambda frame: False,
        stop_requested: Callable[[], bool] | None = None,
    ) -> None:
        """held_out: returns True for frames to exclude from training. stop_requested: polled between optimiser steps; True
        ends the training of the frame.
        """
        self._held_out, self._stop_requested = held_out, stop_requested

    def learn(self, frame: Frame, learner: Learner, frame_waits: Callable[[], bool]) -> Reconstruction | None:
        """Train the configured number of optimiser steps on the frame, or display it untrained (see the class).

        Returns: None for an unusable frame of a scene without a model.
        """
        usable = learner.accepts(frame)
        if not learner.enter(frame, usable=usable):
            return None
        train = learner.newest is None or ((usable or frame.is_followed) and not self._held_out(frame))
        return learner.observe(frame, train=train, stop_requested=self._stop_requested)

    def contribute(self, outcome: OutcomeBuilder, counts: TrainingCounts) -> None:
        if counts.withheld:
            reasons = ", ".join(f"{reason}: {count}" for reason, count in sorted(counts.withheld.items()))
            outcome.note(f"{sum(counts.withheld.values())} frames were withheld and not scored ({reasons})")
        if counts.scenes:
            reasons = ", ".join(f"{reason}: {count}" for reason, count in sorted(counts.scenes.items()))
            outcome.note(
                f"the frames show {1 + sum(counts.scenes.values())} scenes ({reasons}); the saved model is that of the last one"
            )


class UntilDisplay(Training):
    """Trains on each frame until its display deadline, and then on earlier frames (rehearsal) until the next frame.

    Frames that are too late are dropped. Withheld and damaged frames are displayed with the current model and not
    trained on, except blurred frames and possible cuts (`Frame.is_followed`).
    """

    def __init__(
        self, clock: FrameClock, depth: BackgroundDepth | None = None, guard: BehindGuard | None = None
    ) -> None:
        """Create the policy of a live run.

        Args:
            clock: display deadlines and training budgets.
            depth: depth estimator for trained frames; None disables late depth.
            guard: judge of the displayed pictures, which requests that the model is started anew; None never does.
        """
        self._clock, self._depth, self._guard = clock, depth, guard or BehindGuard()
        self.begin()

    def begin(self) -> None:
        """Reset the counters of growth and late depth for a new stream."""
        self._since_grown = 0
        """Number of frames trained on since the last growth step."""
        self._depth_ages = Histogram()
        self._depths_taken = self._depths_dropped = 0

    def take(self, op_input: Any, learner: Learner) -> Frame:
        """Return the oldest queued frame that is not too late."""
        frame: Frame = op_input.receive("frame")
        while (waiting := op_input.queued("frame")) and self._clock.too_late(frame, waiting):
            learner.counts.passed_over += 1
            frame = op_input.receive("frame")
        return frame

    def learn(self, frame: Frame, learner: Learner, frame_waits: Callable[[], bool]) -> Reconstruction | None:
        """Train on a usable frame until its display deadline, and publish the model; None if it cannot be shown."""
        behind, taken_ns = frame_waits(), self._clock.now_ns()
        usable = learner.accepts(frame)
        if not learner.enter(frame, usable=usable):
            return None
        anew = usable and learner.newest is not None and self._guard.renewal_is_due()
        if anew:
            learner.begin_scene(frame, anew=True)
        first = learner.newest is None
        if first:
            self._guard.scene_begun(frame.seq, anew=anew)
        if usable and self._depth is not None:
            self._depth.offer(frame)
        budget = self._clock.budget(frame, first=first, behind=behind)
        shown = learner.observe(frame, budget=budget, train=usable or frame.is_followed)
        if shown.trained:
            # The initialisation of a scene already covers its first frame.
            self._since_grown = 0 if first else self._since_grown + 1
        published_ns = self._clock.now_ns()
        self._clock.published(taken_ns, published_ns, shown.steps, learner.reconstructor.step_ns, first=first)
        return replace(shown, taken_ns=taken_ns, published_ns=published_ns)

    def rest(self, frame: Frame, learner: Learner, frame_waits: Callable[[], bool]) -> None:
        """Take late depth, run a growth step if due, then train on earlier frames until the next frame is queued or expected."""
        if not frame_waits():
            self._clock.wait_until_shown()
        self._take_depth(learner)
        reconstructor = learner.reconstructor
        at_once = REHEARSED_AT_ONCE if reconstructor.device.type == "cuda" else 1
        made = 0

        def has_time() -> bool:
            return not frame_waits() and self._clock.may_rehearse(made, reconstructor.rehearsal_ns(at_once))

        if frame is learner.learned and self._since_grown and (self._since_grown >= GROWN_AT_LATEST or has_time()):
            learner.grow(frame)
            self._since_grown = 0
        while has_time():
            reconstructor.rehearse(at_once)
            made += at_once
        learner.record_rehearsal(made)

    def _take_depth(self, learner: Learner) -> None:
        """Pass the newest late depth estimate of the background thread, if any, to the model."""
        found = None if self._depth is None else self._depth.take()
        if found is None:
            return
        frame, late = found
        if not learner.take_depth(frame, late):
            self._depths_dropped += 1
            return
        self._depths_taken += 1
        if frame.arrived_ns is not None:
            self._depth_ages.record(self._clock.now_ns() - frame.arrived_ns)

    def contribute(self, outcome: OutcomeBuilder, counts: TrainingCounts) -> None:
        if counts.renewed:
            outcome.note(f"the model fell behind the pictures and was started anew {counts.renewed} times")
        age_ms = self._depth_ages.summary().p50_ms
        outcome.add(TakenDepth(self._depths_taken, age_ms, self._depths_dropped))
        if self._depths_taken:
            outcome.note(
                f"the depth of {self._depths_taken} frames was used in training after they were shown, {age_ms:.0f} ms after they had arrived (median)"
            )


class RecordedCalls(Training):
    """Repeats the recorded calls of a live session. Frames that the session dropped are not displayed."""

    def __init__(
        self,
        schedule: Callable[[], Iterator[ScheduleLine | LostLine]],
        late_depths: Callable[[], Iterator[dict[str, Any] | None]],
    ) -> None:
        """Create a policy that repeats a recorded schedule.

        Args:
            schedule: called in `begin`; yields the lines of the schedule from the beginning.
            late_depths: called in `begin`; yields the frame fields for each `take_depth` line, in
                order.
        """
        self._schedule, self._late_depths = schedule, late_depths
        self.missing: int | None = None
        """Sequence number of the first recorded frame that is missing, or whose late depth is missing; later pictures may
        differ. None if complete.
        """
        self._lines: Iterator[ScheduleLine | LostLine] = iter(())
        self._depths: Iterator[dict[str, Any] | None] = iter(())
        self._due: ScheduleLine | LostLine | None = None
        self._has_reconstructor = False
        self._observed: OrderedDict[int, Frame] = OrderedDict()
        """The most recently observed frames, by sequence number."""

    def begin(self) -> None:
        """Open the recorded schedule for a new stream."""
        self.missing, self._has_reconstructor = None, False
        self._observed.clear()
        self._lines, self._depths = self._schedule(), self._late_depths()
        self._due = next(self._lines, None)

    def end(self) -> None:
        """Release the recorded schedule and the kept frames."""
        self._observed.clear()
        self._lines, self._depths = iter(()), iter(())

    def learn(self, frame: Frame, learner: Learner, frame_waits: Callable[[], bool]) -> Reconstruction | None:
        """Repeat the recorded calls up to those of this frame, and publish the model. None for a frame that the session
        did not display.
        """
        observed = self._follow_to(frame, learner)
        if observed is None or not self._has_reconstructor:
            return None
        train = observed.train and frame.status is not FrameStatus.DAMAGED
        if not train or frame.unusable is not None:
            learner.accepts(frame)
        if learner.newest is None and not train:
            return None
        self._observed[frame.seq] = frame
        while len(self._observed) > MOST_LATE:
            self._observed.popitem(last=False)
        return learner.observe(frame, budget=Budget.of_steps(observed.steps), train=train)

    def _follow_to(self, frame: Frame, learner: Learner) -> Observed | None:
        """Replay the calls before the `observe` call of this frame. Return the schedule line of that call; None if
        there is none.
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
                # The learner is constructed with a reconstructor, so only later lines replace it.
                if self._has_reconstructor:
                    learner.renew()
                self._has_reconstructor = True
            elif isinstance(line, DepthTaken | LostLine):
                self._take_depth(line, learner)
            elif self._has_reconstructor:
                self._call(learner, line, frame)
        return None

    def _call(self, learner: Learner, line: SceneBegun | Grown | Rehearsed, frame: Frame) -> None:
        """Replay one recorded call that precedes the `observe` call of `frame`."""
        if isinstance(line, Rehearsed):
            if learner.reconstructor.gaussians:
                learner.reconstructor.rehearse(line.steps)
        elif isinstance(line, Grown):
            if self._observed and line.seq == next(reversed(self._observed)):
                learner.grow(self._observed[line.seq])
        elif line.seq == frame.seq:
            learner.begin_scene(frame, anew=isinstance(line, SceneBegun) and line.anew)

    def _take_depth(self, line: DepthTaken | LostLine, learner: Learner) -> None:
        """Replay a late depth estimate, or note that the frame or depth is missing."""
        fields = next(self._depths, None) if isinstance(line, DepthTaken) else None
        frame = self._observed.get(line.seq)
        if fields is None or frame is None or not self._has_reconstructor:
            self._miss(line.seq)
        else:
            learner.take_depth(frame.with_fields(**fields))

    def _miss(self, seq: int) -> None:
        self.missing = seq if self.missing is None else self.missing

    def contribute(self, outcome: OutcomeBuilder, counts: TrainingCounts) -> None:
        if self.missing is not None:
            outcome.note(
                f"frame {self.missing} was trained on in the session and is not in its recording, or its depth is not: later pictures may differ"
            )
