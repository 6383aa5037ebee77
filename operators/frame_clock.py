"""Time of live frames: display deadlines, the training budget that they leave, and a check that the model keeps up.

A model that cannot follow a fast scope shows its tissue at the wrong place, and training repairs it more slowly than the
pictures move on. The check compares displayed pictures with the previous frame shown again and with the first picture of
the present scene. A model that falls behind both is replaced by a new scene, which shows the newest frame at once.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.schedule import Budget
from operators.settings import check_option

INTERVAL_DECAY = 0.1
"""Weight of the newest frame in the moving average of the frame interval."""
DISPLAY_DECAY = 0.2
"""Weight of the newest picture in the moving averages of training time and display latency."""

REHEARSAL_MARGIN_NS = 300_000
"""Time before the next expected frame at which training on earlier frames (rehearsal) ends, in nanoseconds."""
SHOWN_WITHIN_S = 0.005
"""Longest wait for the newest picture to be displayed before training on earlier frames begins, in seconds."""
AUTO_SHARE, AUTO_MOST_MS, LEAST_SHARE = 0.6, 18.3, 0.34
"""Default display deadline, as a share of the frame interval and its upper limit in milliseconds, and default share of the
interval that is guaranteed for training."""
LATEST_SHARE = 0.85
"""Share of the frame interval after a frame's arrival at which guaranteed training also ends, minus the display latency, so
that the picture is displayed before the next frame arrives (results/live.md).
"""
FIRST_MS = 20.0
"""Display deadline of a scene's first frame after its arrival, in milliseconds."""
FIRST_AT_MOST_STEPS = 60
"""Maximum number of optimiser steps for the first frame of a scene."""
CATCH_UP_SHARE = 0.8
"""Share of the frame interval. Queued frames are caught up with, not dropped, only while training (with the minimum number of
steps) and display each take less."""
CATCH_UP_INTERVALS = 4.0
"""Default for the longest wait of a frame before it is dropped for newer ones, in frame intervals."""


@dataclass(frozen=True)
class ClockSettings:
    """Display deadline of live frames and limits on their optimiser steps. Raises InvalidSetting for a value out of range."""

    budget_ms: float | None = None
    """Display deadline after a frame's arrival, in milliseconds. None: `auto_share` of the frame
    interval, at most `auto_most_ms`.
    """
    auto_share: float | None = None
    auto_most_ms: float | None = None
    """Automatic deadline as a share of the frame interval, and its upper limit in milliseconds. None: device default.
    """
    least_share: float | None = None
    """Share of the frame interval guaranteed for training with an automatic deadline, even past the
    deadline, but not past `LATEST_SHARE`. None: device default.
    """
    least_most_ms: float | None = None
    """Upper limit in milliseconds of the time that `least_share` guarantees, so that pictures of slow streams are not
    late. None: device default.
    """
    at_least_steps: int | None = None
    """Minimum number of optimiser steps per frame, even past the deadline. None: device default."""
    fewest_steps: int | None = None
    """Minimum number of optimiser steps for a frame with further frames queued behind it. None: `at_least_steps`."""
    catch_up_intervals: float | None = None
    """Longest wait of a frame before it is dropped for newer ones, in frame intervals. None: device default."""
    at_most_steps: int = 80
    """Maximum number of optimiser steps before a frame is displayed."""
    first_at_least_steps: int | None = None
    """Minimum number of optimiser steps for the first frame of a scene. None: device default."""
    rehearse_at_most: int = 120
    """Maximum number of optimiser steps on earlier frames (rehearsal) after each frame, however long the next one takes."""

    def __post_init__(self) -> None:
        check_option("budget_ms", self.budget_ms)
        for name in ("auto_share", "least_share"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= 1:
                raise InvalidSetting(f"{name} is {value}; it must be in (0, 1]")
        for name in ("auto_most_ms", "least_most_ms"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= 10_000:
                raise InvalidSetting(f"{name} is {value}; it must be above 0 and at most 10000")
        if self.at_least_steps is not None and not 0 < self.at_least_steps <= self.at_most_steps:
            raise InvalidSetting(
                f"at_least_steps is {self.at_least_steps} and at_most_steps {self.at_most_steps}; they must be in order"
            )
        if self.first_at_least_steps is not None and not 0 < self.first_at_least_steps <= FIRST_AT_MOST_STEPS:
            raise InvalidSetting(
                f"first_at_least_steps is {self.first_at_least_steps} and the limit {FIRST_AT_MOST_STEPS};"
                " they must be in order"
            )
        if self.fewest_steps is not None and not 0 < self.fewest_steps <= (self.at_least_steps or self.at_most_steps):
            raise InvalidSetting(
                f"fewest_steps is {self.fewest_steps} and at_least_steps {self.at_least_steps}; they must be in order"
            )
        if self.catch_up_intervals is not None and not 0 < self.catch_up_intervals < math.inf:
            raise InvalidSetting(f"catch_up_intervals is {self.catch_up_intervals}; it must be positive")


class FrameClock:
    """Deadlines and training budgets of live frames, from measured intervals and latencies.

    The training thread calls `budget`, `may_rehearse`, `too_late` and `published`. The display thread calls `shown`.
    """

    def __init__(self, settings: ClockSettings, fps: float, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Create a clock, with the nominal frame rate until frames arrive.

        Args:
            settings: deadline and step limits.
            fps: nominal frame rate of the source; replaced gradually by the measured rate.
            now_ns: monotonic clock in nanoseconds, the clock of `Frame.arrived_ns`.
        """
        self.settings = settings
        self.now_ns = now_ns
        self.interval_ns = 1e9 / fps
        """Moving average of the time between frames, in nanoseconds."""
        self.display_ns = 2e6
        """Moving average of the latency from a published model to its displayed picture, in nanoseconds."""
        self.training_ns = 0.0
        """Moving average of the time from dequeuing a frame to its published model with the minimum
        number of steps, in nanoseconds.
        """
        self._last_arrival: tuple[int, int] | None = None
        """Arrival time in nanoseconds and sequence number of the newest frame."""
        self._shown = threading.Event()

    def budget(self, frame: Frame, *, first: bool = False, behind: bool = False) -> Budget:
        """Return the training budget of a frame before its display.

        Args:
            frame: the frame to be trained on; its arrival updates the frame interval.
            first: the frame is the first of a scene and gets a larger budget.
            behind: further frames are queued. The frame then gets no time past its deadline and fewer minimum steps, so
                that the queue drains.
        """
        settings = self.settings
        arrived_ns = self.now_ns() if frame.arrived_ns is None else frame.arrived_ns
        self._learn_interval(arrived_ns, frame.seq)
        until_ns = arrived_ns + (FIRST_MS * 1e6 if first else self.show_after_ns) - self.display_ns
        if settings.budget_ms is None and not first and not behind:
            latest_ns = arrived_ns + LATEST_SHARE * self.interval_ns - self.display_ns
            until_ns = max(until_ns, min(latest_ns, self.now_ns() + self.least_ns))
        return Budget.until(
            until_ns * 1e-9,
            at_least=settings.first_at_least_steps or 1 if first else self.least_steps(behind),
            at_most=FIRST_AT_MOST_STEPS if first else settings.at_most_steps,
            clock=lambda: self.now_ns() * 1e-9,
        )

    def least_steps(self, behind: bool) -> int:
        """Return the minimum number of optimiser steps of a frame; `behind`: further frames are queued."""
        at_least = self.settings.at_least_steps or 1
        return self.settings.fewest_steps or at_least if behind else at_least

    @property
    def least_ns(self) -> float:
        """Time guaranteed for training with an automatic deadline, in nanoseconds."""
        share_ns = (self.settings.least_share or LEAST_SHARE) * self.interval_ns
        return min(share_ns, (self.settings.least_most_ms or math.inf) * 1e6)

    @property
    def show_after_ns(self) -> float:
        """Latest intended display of a frame after its arrival, in nanoseconds. Training normally ends before."""
        settings = self.settings
        if settings.budget_ms is not None:
            return settings.budget_ms * 1e6
        return min(
            (settings.auto_share or AUTO_SHARE) * self.interval_ns, (settings.auto_most_ms or AUTO_MOST_MS) * 1e6
        )

    def may_rehearse(self, made: int, ahead_ns: float) -> bool:
        """Return True if another optimiser step on earlier frames (rehearsal) ends before the next frame is expected, and
        fewer than `rehearse_at_most` were made.

        Args:
            made: rehearsal steps since the last frame.
            ahead_ns: duration of the steps that would be in flight, in nanoseconds.
        """
        if made >= self.settings.rehearse_at_most or self._last_arrival is None:
            return False
        return self.now_ns() + ahead_ns < self._last_arrival[0] + self.interval_ns - REHEARSAL_MARGIN_NS

    def too_late(self, frame: Frame, waiting: int) -> bool:
        """Return True if a frame is to be dropped for one of the `waiting` newer frames.

        Queued frames are processed one by one as long as training and display each take less than
        `CATCH_UP_SHARE` of the frame interval and the frame has not waited too long. Training of a
        frame overlaps with the display of the previous one.
        """
        if not waiting or frame.arrived_ns is None:
            return False
        keeps_up = max(self.training_ns, self.display_ns) < CATCH_UP_SHARE * self.interval_ns
        waited_ns = self.now_ns() - frame.arrived_ns
        return not keeps_up or waited_ns > (self.settings.catch_up_intervals or CATCH_UP_INTERVALS) * self.interval_ns

    def published(
        self, taken_ns: int, published_ns: int, steps: int = 0, step_ns: float = 0.0, *, first: bool = False
    ) -> None:
        """Record the publication of a model, which `wait_until_shown` then waits for, and update the average training time.

        Args:
            taken_ns: time at which training dequeued the frame.
            published_ns: time of publication.
            steps: optimiser steps on the frame.
            step_ns: duration of one step; steps above the minimum are subtracted.
            first: the frame is the first of a scene. It also takes the time to create the scene, so the average does not
                include it.
        """
        self._shown.clear()
        if first:
            return
        spared_ns = max(0, steps - self.least_steps(behind=True)) * step_ns
        needed_ns = max(0.0, published_ns - taken_ns - spared_ns)
        self.training_ns += DISPLAY_DECAY * (needed_ns - self.training_ns)

    def shown(self, published_ns: int, shown_ns: int) -> None:
        """Record a displayed picture of the model published at `published_ns`, to update the display latency."""
        # Limit outliers such as the first picture, which includes one-time initialisation.
        seen = min(max(0, shown_ns - published_ns), 4 * self.display_ns + 1e6)
        self.display_ns += DISPLAY_DECAY * (seen - self.display_ns)
        self._shown.set()

    def wait_until_shown(self) -> None:
        """Wait up to `SHOWN_WITHIN_S` for the newest model to be displayed, so that its rendering has the device alone."""
        self._shown.wait(SHOWN_WITHIN_S)

    def _learn_interval(self, arrived_ns: int, seq: int) -> None:
        last, self._last_arrival = self._last_arrival, (arrived_ns, seq)
        if last is None:
            return
        # Divide by the number of frames since the last arrival, including dropped ones. The interval is clipped to
        # ignore pauses and the bursts after them.
        each_ns = (arrived_ns - last[0]) / max(1, seq - last[1])
        seen = min(max(each_ns, 0.2 * self.interval_ns), 5 * self.interval_ns)
        self.interval_ns += INTERVAL_DECAY * (seen - self.interval_ns)


PREVIOUS_MARGIN_DB = 1.0
"""Difference in dB above which a picture counts as worse than the previous raw frame shown again."""
FIRST_MARGIN_DB = 6.0
"""Difference in dB from which a picture counts as worse than the first one of its scene: four times its squared error. A
new scene discards the past, which a smaller gain is not worth. While the scope rests for a few frames, the previous frame
is better than a model that follows well.
"""
RENEW_AFTER = 2
"""Number of consecutive pictures worse than trivial ones (`BehindGuard`) after which the model is started anew. The
picture of a single odd frame recovers by itself.
"""
USEFUL_FRAMES = 16
"""Number of pictures, per bad picture that caused it, after which a renewal of the model counts as useful. If the next
renewal is due earlier, it counts as useless, and the one after it waits for twice as many bad pictures.
"""
COMPARED_ROWS = 128
"""Minimum number of evenly spaced picture rows that are compared. Other rows are skipped to save time before the display."""


class BehindGuard:
    """Judges each displayed picture and requests a new scene after several bad ones.

    A picture is behind if both trivial pictures are better: the previous frame shown again, and a new scene, estimated by
    the first picture of the present one. The display thread calls `judge`, the training thread the other methods.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Discard the pictures judged so far, at the start of a stream."""
        with self._lock:
            self._previous: Frame | None = None
            self._first_seq: int | None = None
            self._first_db = math.nan
            self._run = self._lasted = 0
            self._patience = RENEW_AFTER

    def scene_begun(self, seq: int, *, anew: bool = False) -> None:
        """Record that the model starts a scene with frame `seq`. `anew`: it is the same scene, whose model fell behind."""
        with self._lock:
            helps = not anew or self._lasted >= USEFUL_FRAMES * self._patience
            self._patience = RENEW_AFTER if helps else 2 * self._patience
            self._first_seq, self._first_db = seq, math.nan
            self._run = self._lasted = 0

    def renewal_is_due(self) -> bool:
        """Return True if the next usable frame should start the model anew."""
        with self._lock:
            return self._run >= self._patience

    def judge(self, frame: Frame, image: NDArray[np.uint8]) -> bool:
        """Judge a displayed picture by its frame and the previous one.

        Args:
            frame: frame that the picture reconstructs. Withheld and damaged frames are not compared.
            image: picture uint8 RGB [H, W, 3].

        Returns:
            True if the picture is behind; for a picture that is not compared, True if the last compared one was behind.
            False for the first picture of a scene.
        """
        if frame.unusable is not None:
            return self._run > 0
        previous, self._previous = self._previous, frame
        shown_db = _db(image, frame)
        is_comparable = previous is not None and previous.scene == frame.scene and previous.image.shape == image.shape
        previous_db = _db(previous.image, frame) if previous is not None and is_comparable else math.nan
        with self._lock:
            if self._first_seq is not None:
                if frame.seq >= self._first_seq:
                    self._first_seq, self._first_db = None, shown_db
                return False
            self._lasted += 1
            is_behind = shown_db < min(previous_db - PREVIOUS_MARGIN_DB, self._first_db - FIRST_MARGIN_DB)
            self._run = self._run + 1 if is_behind else 0
        return is_behind


def _db(image: NDArray[np.uint8], frame: Frame) -> float:
    """Return the tissue PSNR of a picture against a frame in dB, over some of the rows; NaN without tissue."""
    every = max(1, image.shape[0] // COMPARED_ROWS)
    mask = frame.tissue
    return psnr_tissue_db(image[::every], frame.image[::every], None if mask is None else mask[::every])
