"""Reconstruction that replays the recorded schedule of a live session."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
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
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.training.live import LiveReconstructor
from gsplat_core.training.placement import MOST_LATE
from operators.messages import Reconstruction
from operators.outcome import OutcomeBuilder
from operators.reconstruct import ReconstructOp


class ScheduledReconstructOp(ReconstructOp):
    """`ReconstructOp` that repeats the recorded calls of a `LiveReconstructor`.

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
        make_reconstructor: Callable[[], LiveReconstructor],
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
        self._live: LiveReconstructor | None = None
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

    def _call(self, live: LiveReconstructor, line: SceneBegun | Grown | Rehearsed, frame: Frame) -> None:
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
