"""What is on the screen: the newest picture, how old it is, and what that means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import FrameStatus
from operators.frame_clock import FrameClock
from operators.graph import ConditionType, MessageOrTimeoutCondition, Operator, OperatorSpec
from operators.graph.tracking import DurationSummary, Histogram
from operators.messages import PictureState, RenderedFrame, ShownPicture
from operators.outcome import OutcomeBuilder
from operators.remembered import RememberedTissue
from operators.sources.source import SourceState

LOOK_NS = 50_000_000
"""How often the state is looked at while no picture comes."""
REPEAT_NS = 200_000_000
"""How often a picture that is not live is sent again, with its age."""
WAITING = 4
"""Pictures that may wait to be shown after a delay."""
COLOURS = {
    PictureState.LIVE: (40, 200, 80),
    PictureState.STALE: (255, 190, 0),
    PictureState.FROZEN: (255, 90, 0),
    PictureState.SOURCE_LOST: (230, 0, 40),
}


@dataclass(frozen=True)
class DisplaySettings:
    """From which age on a picture is no longer live, and what is drawn into it. Raises InvalidSetting for a value out of its range."""

    stale_after_ms: float = 150.0
    stale_after_intervals: float = 3.0
    """The larger of the two counts: a slow camera's pictures are older without anything being wrong."""
    frozen_after_ms: float = 1000.0
    label: bool = True
    """Draw state and age into every picture. A picture that is not live is always labelled."""
    mark_remembered: bool = True
    """Draw tissue that nobody sees at this moment without colour (`RememberedTissue`)."""

    def __post_init__(self) -> None:
        if not 0 < self.stale_after_ms < self.frozen_after_ms <= 60_000:
            raise InvalidSetting(
                f"stale_after_ms is {self.stale_after_ms:g} and frozen_after_ms {self.frozen_after_ms:g}; they must be in"
                " order and at most 60000"
            )
        if not 1 <= self.stale_after_intervals <= 100:
            raise InvalidSetting(f"stale_after_intervals is {self.stale_after_intervals}; it must be between 1 and 100")

    def state(self, age_ns: float, interval_ns: float, source: SourceState) -> PictureState:
        """The state of a picture of that age, where frames come `interval_ns` apart from a source in that state."""
        if source is not SourceState.LIVE:
            return PictureState.SOURCE_LOST
        stale_ns = max(self.stale_after_ms * 1e6, self.stale_after_intervals * interval_ns)
        if age_ns > max(self.frozen_after_ms * 1e6, 2 * stale_ns):
            return PictureState.FROZEN
        return PictureState.STALE if age_ns > stale_ns else PictureState.LIVE


@dataclass(frozen=True)
class LiveDisplayResult:
    """What was on the screen."""

    pictures: int
    """New pictures that were shown."""
    age: DurationSummary
    """Of each new picture when it came on the screen."""
    states: dict[str, int]
    """How often a picture went over into each state."""
    first_picture_ms: float | None
    """From the arrival of the first frame to the first picture."""


class DisplayOp(Operator):
    """Shows each picture as soon as it comes, and says what has become of the last one when none comes.

    Inputs:
        rendered: `RenderedFrame`; the newest one wins.

    Outputs:
        shown: `ShownPicture`.

    Params:
        clock: the run's; it learns how long showing takes.
        source_state: what the source is doing, from any thread.
        settings: from which age on a picture is not live, and what is drawn into it.
    """

    def __init__(
        self,
        fragment: Any,
        *args: Any,
        clock: FrameClock,
        source_state: Callable[[], SourceState],
        settings: DisplaySettings | None = None,
        **kwargs: Any,
    ) -> None:
        self.clock = clock
        self.source_state = source_state
        self.settings = settings or DisplaySettings()
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
        """OpenCV reads its font once in every thread, which takes longer than a frame."""
        cv2.getTextSize("LIVE", cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)

    def _reset(self) -> None:
        self.pictures = 0
        self.state: PictureState | None = None
        """Of what is on the screen; None before the first picture."""
        self.states: dict[str, int] = {}
        self._ages = Histogram()
        self._first_ms: float | None = None
        self._current: RenderedFrame | None = None
        self._sent_ns = 0

    @property
    def age_p50_ms(self) -> float:
        """The usual age of a new picture, in milliseconds."""
        return self._ages.quantiles_ms((0.5,))[0]

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        arrived: RenderedFrame | None = op_input.receive("rendered")
        if arrived is not None:
            self._current = arrived
        if self._current is None:
            return
        now_ns = self.clock.now_ns()
        age_ns = max(0, now_ns - _content_ns(self._current, now_ns))
        state = self.settings.state(age_ns, self.clock.interval_ns, self.source_state())
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
        """The picture with what is drawn into it, a copy where that is anything, and where it shows remembered tissue."""
        image, whole = rendered.image, _nobody_sees(rendered, state)
        remembered = self._tissue.layer(rendered, whole) if self.settings.mark_remembered else None
        label = self.settings.label or state is not PictureState.LIVE
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
        if self._first_ms is None:
            self._first_ms = age_ns * 1e-6
        if rendered.published_ns is not None:
            self.clock.shown(rendered.published_ns, shown_ns)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """See `Contributor`."""
        outcome.add(LiveDisplayResult(self.pictures, self._ages.summary(), dict(self.states), self._first_ms))


def _content_ns(rendered: RenderedFrame, now_ns: int) -> int:
    """When the newest frame that a picture shows arrived."""
    content = rendered.content or rendered.frame
    return now_ns if content.arrived_ns is None else content.arrived_ns


def _nobody_sees(rendered: RenderedFrame, state: PictureState) -> bool:
    """Whether all that a picture shows is remembered: no frame has come for long, or those that came showed nothing of it. A picture that
    is merely late is not: a slow machine shows what was seen a moment ago."""
    unused = rendered.frame.withheld is not None or rendered.frame.status is FrameStatus.DAMAGED
    return state in (PictureState.FROZEN, PictureState.SOURCE_LOST) or (state is PictureState.STALE and unused)


def draw_label(picture: NDArray[np.uint8], state: PictureState, age_ns: float) -> None:
    """Draw state and age into the upper left corner, in place; a picture that is not live gets a frame of the state's colour."""
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
