"""Online reconstruction by a recorded schedule: the calls that a live session made, made again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from gsplat_core.io.sessions.schedule import Grown, Observed, ReconstructorMade, Rehearsed, SceneBegun, ScheduleLine
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.live import LiveReconstructor
from operators.messages import Reconstruction
from operators.outcome import OutcomeBuilder
from operators.reconstruct import ReconstructOp


class ScheduledReconstructOp(ReconstructOp):
    """As `ReconstructOp`, with a `LiveReconstructor` that is called as the schedule says. A frame that the session passed over goes no further.

    Params:
        make_reconstructor: called where the schedule says that one was made.
        schedule: its lines from the beginning; called in `start()`.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        make_reconstructor: Callable[[], LiveReconstructor],
        schedule: Callable[[], Iterator[ScheduleLine]],
        **kwargs: Any,
    ) -> None:
        self.make_live, self.schedule = make_reconstructor, schedule
        self.missing: int | None = None
        """The first frame that was trained on in the session and is not there now: from it on pictures may differ."""
        self._lines: Iterator[ScheduleLine] = iter(())
        self._due: ScheduleLine | None = None
        self._live: LiveReconstructor | None = None
        self._observed: Frame | None = None
        """The frame that was observed last."""
        super().__init__(fragment, *args, make_reconstructor=make_reconstructor, **kwargs)

    def start(self) -> None:
        self.newest = self.missing = self._live = self._observed = None
        self._lines = self.schedule()
        self._due = next(self._lines, None)

    def stop(self) -> None:
        if self.newest is not None and self._live is not None:
            self.newest = self._live.whole_model(self.newest)
        super().stop()
        if self._live is not None:
            self._eyes = self._live.eyes.trained
        self._live = self._observed = None
        self._lines = iter(())

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        frame: Frame = op_input.receive("frame")
        observed = self._follow_to(frame)
        if observed is None or self._live is None:
            return
        train = observed.train and frame.status is not FrameStatus.DAMAGED
        if self.newest is None and not train:
            return
        self._observed = frame
        report = self._live.observe(frame, steps=observed.steps, train=train)
        self.newest = self._live.publish()
        op_output.emit(
            Reconstruction(frame, self.newest, trained=train, steps=report.steps, arriving_loss=report.arriving_loss),
            "reconstruction",
        )

    def _follow_to(self, frame: Frame) -> Observed | None:
        """Make the calls that came before this frame was observed; None where it never was."""
        while self._due is not None:
            line = self._due
            if isinstance(line, Observed | SceneBegun) and line.seq > frame.seq:
                return None
            self._due = next(self._lines, None)
            if isinstance(line, Observed):
                if line.seq == frame.seq:
                    return line
                self.missing = line.seq if self.missing is None else self.missing
            elif isinstance(line, ReconstructorMade):
                self._live, self.newest = self.make_live(), None
            elif isinstance(line, Rehearsed):
                if self._live is not None and self._live.gaussians:
                    self._live.rehearse(line.steps)
            elif isinstance(line, Grown):
                if self._live is not None and self._observed is not None and line.seq == self._observed.seq:
                    self._live.grow(self._observed)
            elif line.seq == frame.seq and self._live is not None:
                self._live.begin_scene(frame)
                self.newest = None
        return None

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        super().contribute(outcome)
        if self.missing is not None:
            outcome.note(
                f"frame {self.missing} was trained on in the session and is not in its recording: later pictures may differ"
            )
