"""Display of the newest picture with its age and state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.training.metrics import SETTLING_S
from operators.frame_clock import BehindGuard, FrameClock
from operators.graph import ConditionType, MessageOrTimeoutCondition, Operator, OperatorSpec
from operators.graph.tracking import DurationSummary, Histogram
from operators.messages import PictureState, RenderedFrame, ShownPicture
from operators.outcome import OutcomeBuilder
from operators.remembered import RememberedTissue
from operators.sources.source import SourceState

LOOK_NS = 50_000_000
"""Period in nanoseconds at which the display's state is checked while no picture arrives."""
REPEAT_NS = 200_000_000
"""Period in nanoseconds at which a stale, frozen or lost picture is emitted again with its current age."""
LEAST_LABELLED_PX = 160
"""Minimum height in pixels of a live picture that is labelled with its state and age; a picture that is not live always is.
The label has a minimum size to be legible, and would cover much of a smaller picture.
"""
WAITING = 4
"""Capacity of the input queue, in pictures."""
COLOURS = {
    PictureState.LIVE: (40, 200, 80),
    PictureState.BEHIND: (255, 190, 0),
    PictureState.STALE: (255, 190, 0),
    PictureState.FROZEN: (255, 90, 0),
    PictureState.SOURCE_LOST: (230, 0, 40),
}


STALE_AFTER_NS, STALE_AFTER_INTERVALS = 150e6, 3.0
"""Age beyond which a picture is stale: the larger of a time in nanoseconds and a multiple of the frame interval, because
pictures of a slow camera are older.
"""
FROZEN_AFTER_NS = 1000e6
"""Age beyond which a picture is frozen, in nanoseconds; at least twice the stale limit applies."""


def picture_state(age_ns: float, interval_ns: float, source: SourceState) -> PictureState:
    """Return the state of the displayed picture.

    Args:
        age_ns: time since the picture's content arrived, in nanoseconds.
        interval_ns: usual time between frames, in nanoseconds.
        source: current state of the source; any state but `LIVE` gives `SOURCE_LOST`.
    """
    if source is not SourceState.LIVE:
        return PictureState.SOURCE_LOST
    stale_ns = max(STALE_AFTER_NS, STALE_AFTER_INTERVALS * interval_ns)
    if age_ns > max(FROZEN_AFTER_NS, 2 * stale_ns):
        return PictureState.FROZEN
    return PictureState.STALE if age_ns > stale_ns else PictureState.LIVE


@dataclass(frozen=True)
class LiveDisplayResult:
    """Statistics of the live display during a run."""

    pictures: int
    """Number of new pictures; repetitions are not counted."""
    age: DurationSummary
    """Distribution of the age of each new picture at the time of display."""
    settled_age: DurationSummary
    """Distribution of the ages of new pictures at display after the first `SETTLING_S` seconds of the stream."""
    used_age: DurationSummary
    """Distribution of `settled_age` without pictures of withheld and damaged frames, which show the content of an
    earlier frame.
    """
    states: dict[str, int]
    """Number of transitions into each state, by name."""
    first_picture_ms: float | None
    """Time from the arrival of the first frame to the first picture, in milliseconds; None without a picture."""


class DisplayOp(Operator):
    """Emits each picture as soon as it arrives, and repeats the last one with its state and age if none arrives.

    Inputs:
        rendered: `RenderedFrame`; the oldest are dropped if the queue is full.

    Outputs:
        shown: `ShownPicture`.

    Params:
        clock: clock of the run; receives the measured display latency.
        source_state: returns the state of the source; thread-safe.
        guard: judge of the pictures, shared with training; None for one without effect on training.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        clock: FrameClock,
        source_state: Callable[[], SourceState],
        guard: BehindGuard | None = None,
        **kwargs: Any,
    ) -> None:
        self.clock, self._guard = clock, guard or BehindGuard()
        self.source_state = source_state
        self._tissue = RememberedTissue()
        self._reset()
        super().__init__(fragment, MessageOrTimeoutCondition(fragment, LOOK_NS), *args, **kwargs)

    def setup(self, spec: OperatorSpec) -> None:
        port = spec.input("rendered", policy="drop_oldest", type=RenderedFrame).condition(ConditionType.NONE)
        port.connector(port.ConnectorType.DEFAULT, capacity=WAITING)
        spec.output("shown", type=ShownPicture).condition(ConditionType.NONE)

    def start(self) -> None:
        self._reset()

    def prepare_thread(self) -> None:
        """Load OpenCV's font in this thread. The first use in a thread takes longer than a frame interval."""
        cv2.getTextSize("LIVE", cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)

    def _reset(self) -> None:
        self.pictures = 0
        self.state: PictureState | None = None
        """State of the displayed picture; None before the first one."""
        self.states: dict[str, int] = {}
        self._ages, self._settled_ages, self._used_ages = Histogram(), Histogram(), Histogram()
        self._first_ms: float | None = None
        self._first_s: float | None = None
        self._current: RenderedFrame | None = None
        self._sent_ns = 0
        self._is_behind = False
        self._guard.reset()

    @property
    def age_p50_ms(self) -> float:
        """Median age of new pictures at display, in milliseconds."""
        return self._ages.quantiles_ms((0.5,))[0]

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        arrived: RenderedFrame | None = op_input.receive("rendered")
        if arrived is not None:
            self._current = arrived
            self._is_behind = self._guard.judge(arrived.frame, arrived.image)
        if self._current is None:
            return
        now_ns = self.clock.now_ns()
        age_ns = max(0, now_ns - _content_ns(self._current, now_ns))
        state = picture_state(age_ns, self.clock.interval_ns, self.source_state())
        if self._is_behind and state is PictureState.LIVE:
            state = PictureState.BEHIND
        changed = state is not self.state
        repeat = state is not PictureState.LIVE and now_ns - self._sent_ns >= REPEAT_NS
        if arrived is None and not changed and not repeat:
            return
        if changed:
            self.states[state.value] = self.states.get(state.value, 0) + 1
        self.state, self._sent_ns = state, now_ns
        image, remembered = self._drawn(self._current, state, age_ns)
        shown_ns = self.clock.now_ns()
        if arrived is not None:
            self._count(arrived, shown_ns)
        new = arrived is not None
        op_output.emit(ShownPicture(self._current, image, state, age_ns, shown_ns, new, remembered), "shown")

    def _drawn(
        self, rendered: RenderedFrame, state: PictureState, age_ns: float
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
        """Return the picture with its overlays, and the mask of remembered tissue.

        The picture is copied only if something is drawn. The mask is None if nothing is marked.
        """
        image, whole = rendered.image, _is_outdated(rendered, state)
        remembered = self._tissue.layer(rendered, whole)
        labelled = image.shape[0] >= LEAST_LABELLED_PX
        label = labelled or state is not PictureState.LIVE
        if label or remembered is not None:
            image = image.copy()
        if remembered is not None:
            self._tissue.mark(image, remembered, None if whole else (rendered.content or rendered.frame).mask)
        if label:
            draw_label(image, state, age_ns)
        return image, remembered

    def _count(self, rendered: RenderedFrame, shown_ns: int) -> None:
        age_ns = max(0, shown_ns - _content_ns(rendered, shown_ns))
        self.pictures += 1
        self._ages.record(age_ns)
        if self._first_ms is None or self._first_s is None:
            self._first_ms, self._first_s = age_ns * 1e-6, rendered.frame.time_s
        if rendered.frame.time_s - self._first_s >= SETTLING_S:
            self._settled_ages.record(age_ns)
            if rendered.frame.unusable is None:
                self._used_ages.record(age_ns)
        if rendered.published_ns is not None:
            self.clock.shown(rendered.published_ns, shown_ns)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        ages, settled, used = self._ages.summary(), self._settled_ages.summary(), self._used_ages.summary()
        outcome.add(LiveDisplayResult(self.pictures, ages, settled, used, dict(self.states), self._first_ms))


def _content_ns(rendered: RenderedFrame, now_ns: int) -> int:
    """Return the arrival time of the newest frame whose content the picture shows; `now_ns` if unknown."""
    content = rendered.content or rendered.frame
    return now_ns if content.arrived_ns is None else content.arrived_ns


def _is_outdated(rendered: RenderedFrame, state: PictureState) -> bool:
    """Return True if no part of the picture is currently visible to the endoscope.

    This holds for frozen pictures and a lost source. It also holds for a stale picture whose frame
    was withheld or damaged. A picture that is only late shows tissue seen a moment ago.
    """
    unused = rendered.frame.unusable is not None
    return state in (PictureState.FROZEN, PictureState.SOURCE_LOST) or (state is PictureState.STALE and unused)


def draw_label(picture: NDArray[np.uint8], state: PictureState, age_ns: float) -> None:
    """Draw state and age into the upper left corner, in place.

    A picture that is not live also gets a border in the colour of its state.

    Args:
        picture: uint8 RGB [H, W, 3], modified.
        state: state that selects text and colour.
        age_ns: age in nanoseconds.
    """
    height, width = picture.shape[:2]
    colour = COLOURS[state]
    scale = max(0.35, height / 1000)
    text = f"{state.value.upper()} {_age_text(age_ns)}"
    thickness = max(1, round(scale * 2))
    (text_width, text_height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    pad = max(2, text_height // 2)
    box = (min(width - 1, text_width + 2 * pad), min(height - 1, text_height + below + 2 * pad))
    cv2.rectangle(picture, (0, 0), box, (0, 0, 0), cv2.FILLED)
    cv2.putText(
        picture, text, (pad, pad + text_height), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thickness, cv2.LINE_AA
    )
    if state is not PictureState.LIVE:
        edge = max(2, height // 80)
        cv2.rectangle(picture, (0, 0), (width - 1, height - 1), colour, edge)


def _age_text(age_ns: float) -> str:
    return f"{age_ns * 1e-6:.0f} ms" if age_ns < 1e9 else f"{age_ns * 1e-9:.1f} s"
