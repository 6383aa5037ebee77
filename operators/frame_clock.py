"""When a live frame has to be shown, and how much training that leaves room for."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import Frame
from gsplat_core.training.budget import Budget

INTERVAL_DECAY = 0.1
"""How fast the usual interval between frames follows the newest ones."""
DISPLAY_DECAY = 0.2
"""How fast the usual time from a published model to its shown picture follows the newest ones."""

REHEARSAL_MARGIN_NS = 300_000
"""Rehearsal ends so long before the next frame is due."""
SHOWN_WITHIN_S = 0.005
"""Rehearsal waits so long for a picture to be shown."""
AUTO_SHARE, AUTO_MOST_MS, LEAST_SHARE = 0.6, 18.3, 0.34
"""Used where `ClockSettings` says nothing."""
CATCH_UP_SHARE = 0.8
"""Frames that take a larger share of the time between them, with the fewest steps, cannot be caught up with."""
CATCH_UP_INTERVALS = 4.0
"""Used where `ClockSettings.catch_up_intervals` says nothing."""


@dataclass(frozen=True)
class ClockSettings:
    """When frames are shown. Raises InvalidSetting for a value out of its range."""

    budget_ms: float | None = None
    """A frame is to be shown so long after it has come; None: `auto_share` of the time between frames, at most `auto_most_ms`."""
    auto_share: float | None = None
    auto_most_ms: float | None = None
    """Both None: as suits the device."""
    least_share: float | None = None
    """Training gets so much of the time between frames, though a frame that had to wait is shown later for it; None: as suits the device."""
    at_least_steps: int | None = None
    """Steps that a frame gets, though it is shown late; None: as suits the device."""
    fewest_steps: int | None = None
    """The same of a frame that others wait behind: so that all of them can be shown; None: as any other."""
    catch_up_intervals: float | None = None
    """A frame that has waited for longer than so many times the time between frames is passed over for newer ones; None: as suits the device."""
    at_most_steps: int = 80
    """Steps before a frame is shown, though there is time left."""
    first_ms: float = 20.0
    """A scene's first frame may take so long, at least `first_at_least_steps`."""
    first_at_least_steps: int | None = None
    """None: as suits the device."""
    first_at_most_steps: int = 60
    rehearse_at_most: int = 120
    """Steps on the window between two frames, though no frame comes."""

    def __post_init__(self) -> None:
        if self.budget_ms is not None and not 0 < self.budget_ms <= 10_000:
            raise InvalidSetting(f"budget-ms is {self.budget_ms}; it must be auto, or between 0 and 10000 milliseconds")
        for name in ("auto_share", "least_share"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= 1:
                raise InvalidSetting(f"{name} is {value}; it must be in (0, 1]")
        if self.auto_most_ms is not None and not 0 < self.auto_most_ms <= 10_000:
            raise InvalidSetting(f"auto_most_ms is {self.auto_most_ms}; it must be above 0 and at most 10000")
        if self.at_least_steps is not None and not 0 < self.at_least_steps <= self.at_most_steps:
            raise InvalidSetting(
                f"at_least_steps is {self.at_least_steps} and at_most_steps {self.at_most_steps}; they must be in order"
            )
        if self.first_at_least_steps is not None and not 0 < self.first_at_least_steps <= self.first_at_most_steps:
            raise InvalidSetting(
                f"first_at_least_steps is {self.first_at_least_steps} and first_at_most_steps {self.first_at_most_steps};"
                " they must be in order"
            )
        if self.fewest_steps is not None and not 0 < self.fewest_steps <= (self.at_least_steps or self.at_most_steps):
            raise InvalidSetting(
                f"fewest_steps is {self.fewest_steps} and at_least_steps {self.at_least_steps}; they must be in order"
            )
        if self.catch_up_intervals is not None and not 0 < self.catch_up_intervals < math.inf:
            raise InvalidSetting(f"catch_up_intervals is {self.catch_up_intervals}; it must be positive")


class FrameClock:
    """The time of each frame. `arrived`, `budget` and `may_rehearse` are called by the thread that trains, `shown` by the one that shows."""

    def __init__(self, settings: ClockSettings, fps: float, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """fps: the source's nominal rate, until the frames themselves say more."""
        self.settings = settings
        self.now_ns = now_ns
        self.interval_ns = 1e9 / fps
        """Usual time between frames."""
        self.display_ns = 2e6
        """Usual time from a published model to its shown picture."""
        self.training_ns = 0.0
        """Usual time from taking a frame to its published model, had it had the fewest steps."""
        self._last_arrival: tuple[int, int] | None = None
        """When the newest frame came, and its number."""
        self._shown = threading.Event()

    def budget(self, frame: Frame, *, first: bool = False, behind: bool = False) -> Budget:
        """The training that a frame may take before it is shown; the `first` one of a scene takes longer.

        A frame that others wait `behind` gets no more than its time holds: after a delay that is how it is caught up with.
        """
        settings = self.settings
        arrived_ns = self.now_ns() if frame.arrived_ns is None else frame.arrived_ns
        self._learn_interval(arrived_ns, frame.seq)
        until_ns = arrived_ns + (settings.first_ms * 1e6 if first else self.show_after_ns) - self.display_ns
        if settings.budget_ms is None and not first and not behind:
            until_ns = max(until_ns, self.now_ns() + (settings.least_share or LEAST_SHARE) * self.interval_ns)
        return Budget.until(
            until_ns * 1e-9,
            at_least=settings.first_at_least_steps or 1 if first else self.least_steps(behind),
            at_most=settings.first_at_most_steps if first else settings.at_most_steps,
            clock=lambda: self.now_ns() * 1e-9,
        )

    def least_steps(self, behind: bool) -> int:
        """Steps that a frame gets at least, with others waiting `behind` it or not."""
        at_least = self.settings.at_least_steps or 1
        return self.settings.fewest_steps or at_least if behind else at_least

    @property
    def show_after_ns(self) -> float:
        """How long after its arrival a frame is to be shown."""
        settings = self.settings
        if settings.budget_ms is not None:
            return settings.budget_ms * 1e6
        return min(
            (settings.auto_share or AUTO_SHARE) * self.interval_ns, (settings.auto_most_ms or AUTO_MOST_MS) * 1e6
        )

    def may_rehearse(self, made: int, ahead_ns: float) -> bool:
        """Whether there is room for more rehearsal: `made` steps were made since the last frame, and those that would be under way take
        `ahead_ns`. It ends just before the next frame is due here, so that the frame finds the device free."""
        if made >= self.settings.rehearse_at_most or self._last_arrival is None:
            return False
        return self.now_ns() + ahead_ns < self._last_arrival[0] + self.interval_ns - REHEARSAL_MARGIN_NS

    def too_late(self, frame: Frame, waiting: int) -> bool:
        """Whether a frame is passed over for one of the `waiting` newer ones. After a delay frames are caught up with one by one, as long
        as that takes less time than there is between them, and none is shown very late. One is trained on while the last is being shown."""
        if not waiting or frame.arrived_ns is None:
            return False
        keeps_up = max(self.training_ns, self.display_ns) < CATCH_UP_SHARE * self.interval_ns
        waited_ns = self.now_ns() - frame.arrived_ns
        return not keeps_up or waited_ns > (self.settings.catch_up_intervals or CATCH_UP_INTERVALS) * self.interval_ns

    def published(self, taken_ns: int, published_ns: int, steps: int = 0, step_ns: float = 0.0) -> None:
        """The model of a frame that was taken then, and got so many steps of that length, is published now."""
        self._shown.clear()
        spared_ns = max(0, steps - self.least_steps(behind=True)) * step_ns
        needed_ns = max(0.0, published_ns - taken_ns - spared_ns)
        self.training_ns += DISPLAY_DECAY * (needed_ns - self.training_ns)

    def shown(self, published_ns: int, shown_ns: int) -> None:
        """A picture of the model that was published then is shown now."""
        # One that took very long, as a first one may, says little about the next.
        seen = min(max(0, shown_ns - published_ns), 4 * self.display_ns + 1e6)
        self.display_ns += DISPLAY_DECAY * (seen - self.display_ns)
        self._shown.set()

    def wait_until_shown(self) -> None:
        """Wait until the newest published model is shown, but not for long: its picture has the device for itself meanwhile."""
        self._shown.wait(SHOWN_WITHIN_S)

    def _learn_interval(self, arrived_ns: int, seq: int) -> None:
        last, self._last_arrival = self._last_arrival, (arrived_ns, seq)
        if last is None:
            return
        # Frames that were passed over have come, too. A pause is no interval, and neither is a burst after one.
        each_ns = (arrived_ns - last[0]) / max(1, seq - last[1])
        seen = min(max(each_ns, 0.2 * self.interval_ns), 5 * self.interval_ns)
        self.interval_ns += INTERVAL_DECAY * (seen - self.interval_ns)
