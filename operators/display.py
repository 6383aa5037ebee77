"""Display of the newest picture with its age and state, and marks on remembered tissue.

Remembered tissue is rendered because it was seen earlier, but the camera does not see it now.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.ops.arguments import require_shape
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians
from gsplat_core.training.metrics import SETTLING_S
from operators.frame_clock import BehindGuard, FrameClock
from operators.graph import ConditionType, MessageOrTimeoutCondition, Operator, OperatorSpec
from operators.graph.tracking import DurationSummary, Histogram
from operators.messages import PictureState, RenderedFrame, ShownPicture
from operators.outcome import OutcomeBuilder
from operators.sources.source import SourceState

COVERED = 0.1
"""Minimum opacity of a covered pixel. Below it a pixel is nearly black and not marked."""
DARKENED = 0.65
"""Brightness factor of remembered tissue, which is drawn in grey."""
LINES_PER_HEIGHT = 300
"""Picture height divided by outline width. Gives 2 px at 512 px, which survives video coding."""


class RememberedTissue:
    """Finds and marks remembered tissue in pictures from the endoscope's own view.

    Reuses work buffers of the size of the last picture. Not thread-safe.
    """

    def __init__(self) -> None:
        self._resize(0, 0)
        self._found: tuple[NDArray[np.uint8], tuple[int, int, int, int]] | None = None
        """Newest mask of remembered tissue, with its bounding box (left, top, width, height in pixels); None before the first."""

    def _resize(self, height_px: int, width_px: int) -> None:
        self._grey, self._tools, self._scratch = (np.empty((height_px, width_px), np.uint8) for _ in range(3))
        self._colourless = np.empty((height_px, width_px, 3), np.uint8)

    def layer(self, rendered: RenderedFrame, whole: bool = False) -> NDArray[np.uint8] | None:
        """Return the mask of rendered tissue that is not visible in the content's frame.

        Such tissue is behind a tool, under the recorder's on-screen display, or outside of the field of view.

        Args:
            rendered: the picture with its frame and opacity.
            whole: no part of the picture is currently visible, so that all covered pixels are marked.

        Returns:
            uint8 [H, W], 255 = remembered, 0 elsewhere; None if no pixel is.
        """
        seen = (rendered.content or rendered.frame).tissue
        if whole or (seen is not None and seen.shape != rendered.alpha.shape):
            layer = np.asarray(cv2.inRange(rendered.alpha, COVERED, np.inf), np.uint8)
        elif seen is None:
            return None
        else:
            layer = np.empty(seen.shape, np.uint8)
            cv2.threshold(np.asarray(seen, np.uint8), 0, 255, cv2.THRESH_BINARY_INV, dst=layer)
            left, top, wide, high = box = _box(layer)
            if not wide:
                return None
            self._found = layer, box
            hidden, alpha = (plane[top : top + high, left : left + wide] for plane in (layer, rendered.alpha))
            # Fast path: the masked area is usually opaque everywhere. NaN fails the comparison.
            if alpha.min() >= COVERED:
                return layer
            cv2.bitwise_and(hidden, cv2.inRange(alpha, COVERED, np.inf), dst=hidden)
        return layer if cv2.countNonZero(layer) else None

    def mark(
        self, picture: NDArray[np.uint8], layer: NDArray[np.uint8], tissue: NDArray[np.uint8] | None = None
    ) -> None:
        """Draw masked pixels in dark grey, in place.

        Args:
            picture: uint8 RGB [H, W, 3], modified.
            layer: uint8 [H, W] from `layer`, 255 = remembered.
            tissue: uint8 [H, W], 0 = tool; draws a light outline along tool borders. None for no outline.
        """
        height, width = layer.shape
        if self._grey.shape != layer.shape:
            self._resize(height, width)
        line = max(1, round(height / LINES_PER_HEIGHT))
        known = self._found is not None and self._found[0] is layer
        left, top, wide, high = self._found[1] if known and self._found is not None else _box(layer)
        rows = slice(max(0, top - line), min(height, top + high + line))
        columns = slice(max(0, left - line), min(width, left + wide + line))
        marked, pixels = layer[rows, columns], picture[rows, columns]
        grey, colourless = self._grey[rows, columns], self._colourless[rows, columns]
        cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY, dst=grey)
        cv2.convertScaleAbs(grey, dst=grey, alpha=DARKENED)
        if tissue is not None and tissue.shape == layer.shape:
            cv2.max(grey, self._line(tissue, rows, columns, line), dst=grey)
        cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB, dst=colourless)
        cv2.copyTo(colourless, marked, pixels)

    def _line(self, tissue: NDArray[np.uint8], rows: slice, columns: slice, width_px: int) -> NDArray[np.uint8]:
        """Return a mask of the outline inside the tools: 255 at tool pixels within `width_px` of tissue, 0 elsewhere."""
        tools, inner = self._tools[rows, columns], self._scratch[rows, columns]
        cv2.threshold(np.asarray(tissue[rows, columns], np.uint8), 0, 255, cv2.THRESH_BINARY_INV, dst=tools)
        # Erosion treats pixels beyond the picture's border as tool, so no line is drawn along it.
        cv2.erode(tools, np.ones((2 * width_px + 1, 2 * width_px + 1), np.uint8), dst=inner)
        return np.asarray(cv2.subtract(tools, inner, dst=inner), np.uint8)


def _box(layer: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """Return the bounding box of nonzero pixels: left, top, width, height."""
    left, top, wide, high = cv2.boundingRect(layer)
    return left, top, wide, high


def marked(rendered: RenderedFrame) -> NDArray[np.uint8]:
    """Return the rendered picture with remembered tissue marked. It is a copy only if something is marked."""
    tissue = RememberedTissue()
    layer = tissue.layer(rendered)
    if layer is None:
        return rendered.image
    picture = rendered.image.copy()
    tissue.mark(picture, layer, (rendered.content or rendered.frame).mask)
    return picture


def share_of(gaussians: Gaussians, chosen: Tensor, camera: Camera) -> Tensor:
    """Return each pixel's share of chosen Gaussians in the blended weight.

    Args:
        gaussians: all Gaussians.
        chosen: bool [N].
        camera: camera of the picture.

    Returns:
        [H, W] in 0..1; 0 where nothing is rendered.
    """
    require_shape("chosen", chosen, (gaussians.count,), "[N]")
    colours = (chosen.to(gaussians.dtype) - 0.5) / SH_C0
    with torch.no_grad():
        seen = render(replace(gaussians, sh=colours[:, None, None].expand(-1, 1, 3).contiguous()), camera, depth=False)
    return torch.where(seen.alpha > 0, seen.image[..., 0] / seen.alpha.clamp(min=1e-6), 0).clamp(0, 1)


POLL_NS = 50_000_000
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
    """Distribution of the ages of new pictures at display (time since their content arrived), after the first `SETTLING_S`
    seconds of the stream.
    """
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
        super().__init__(fragment, MessageOrTimeoutCondition(fragment, POLL_NS), *args, **kwargs)

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
