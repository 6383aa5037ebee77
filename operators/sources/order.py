"""Numbers and times of a sender that is not ours, put into the order that a `FrameSource` promises."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gsplat_core.scene.frames import Frame

RESET_S = 1.0
"""A sender whose time falls back by more has begun again, rather than sent a frame late."""
JUMP_S = 2.0
"""A sender's time that runs ahead of our clock by more, between two frames, has been set."""
MOST_LOST = 1_000_000
"""Numbers that are missing between two frames; more than that is no loss but another way of counting."""
RESET_FRAMES = 3
"""So many late frames in a row, in order among themselves, are a sender that has begun again."""


class FrameOrder:
    """Makes `seq` increase and `pts_ns` rise, whatever a sender does.

    A frame that comes twice and one that comes after its time are dropped. A sender that begins again (its numbers or its time fall back)
    or whose clock is set goes on from where it was: the step between the two frames is what our own clock says. Everything is counted.
    """

    def __init__(self, *, trusted: bool = False) -> None:
        """trusted: the sender's numbers and times are in order but begin anew after `restart`; nothing else is looked at."""
        self._trusted = trusted
        self._counts: Counter[str] = Counter()
        self.begin()

    @property
    def counts(self) -> Mapping[str, int]:
        """How often what was done, by reason: `duplicates`, `out_of_order`, `missing`, `clock_resets`, `clock_jumps`, `repaired_times`."""
        return self._counts

    def begin(self) -> None:
        """Forget everything: the next frame is the first one, and gets number 0 and time 0."""
        self._counts.clear()
        self._out: Frame | None = None  # as it was handed on
        self._in: Frame | None = None  # the same, as the sender sent it
        self._arrived_ns = 0
        self._seq_offset = self._pts_offset_ns = 0
        self._late: Frame | None = None
        self._late_count = 0
        self._restarted = False

    def restart(self) -> None:
        """The next frame comes over a new connection: what it says of numbers and times begins anew."""
        self._restarted = True

    def take(self, frame: Frame, arrived_ns: int) -> Frame | None:
        """The frame with its number and time put right; None for one to be dropped. arrived_ns: when it came in."""
        known, out = self._in, self._out
        if known is None:
            if not self._trusted:
                # From nought: a time since the start of some machine has too many digits for single precision.
                self._seq_offset, self._pts_offset_ns = -frame.seq, -frame.pts_ns
            return self._accept(frame, frame.pts_ns + self._pts_offset_ns, arrived_ns)
        assert out is not None
        if self._restarted:
            return self._rebase(frame, arrived_ns, None)
        if self._trusted:
            return self._accept(frame, frame.pts_ns + self._pts_offset_ns, arrived_ns)
        if frame.seq == known.seq or (frame.pts_ns == known.pts_ns and same_picture(frame, known)):
            self._counts["duplicates"] += 1
            return None
        if frame.seq < known.seq or frame.pts_ns < known.pts_ns:
            if known.pts_ns - frame.pts_ns > RESET_S * 1e9 or self._is_a_new_beginning(frame):
                return self._rebase(frame, arrived_ns, "clock_resets")
            self._counts["out_of_order"] += 1
            return None
        if frame.seq - known.seq > MOST_LOST:
            return self._rebase(frame, arrived_ns, "clock_resets")
        ahead_ns = (frame.pts_ns - known.pts_ns) - max(0, arrived_ns - self._arrived_ns)
        if ahead_ns > JUMP_S * 1e9:
            return self._rebase(frame, arrived_ns, "clock_jumps")
        self._counts["missing"] += frame.seq - known.seq - 1
        pts_ns = frame.pts_ns + self._pts_offset_ns
        if pts_ns <= out.pts_ns:
            self._counts["repaired_times"] += 1
            pts_ns = out.pts_ns + 1
        return self._accept(frame, pts_ns, arrived_ns)

    def _is_a_new_beginning(self, frame: Frame) -> bool:
        """Whether the late frames of late are a stream of their own."""
        late = self._late
        goes_on = late is not None and frame.seq > late.seq and frame.pts_ns >= late.pts_ns
        self._late_count = self._late_count + 1 if goes_on else 1
        self._late = frame
        return self._late_count >= RESET_FRAMES

    def _rebase(self, frame: Frame, arrived_ns: int, reason: str | None) -> Frame:
        """Go on from the last frame by as much time as passed here, with the next number."""
        assert self._out is not None
        if reason is not None:
            self._counts[reason] += 1
        pts_ns = self._out.pts_ns + max(1, arrived_ns - self._arrived_ns)
        self._pts_offset_ns = pts_ns - frame.pts_ns
        self._seq_offset = self._out.seq + 1 - frame.seq
        return self._accept(frame, pts_ns, arrived_ns)

    def _accept(self, frame: Frame, pts_ns: int, arrived_ns: int) -> Frame:
        out = frame
        if (self._seq_offset, pts_ns, arrived_ns) != (0, frame.pts_ns, frame.arrived_ns):
            out = replace(frame, seq=frame.seq + self._seq_offset, pts_ns=pts_ns, arrived_ns=arrived_ns)
        self._in, self._out, self._arrived_ns = frame, out, arrived_ns
        self._late, self._late_count, self._restarted = None, 0, False
        return out


def same_picture(a: Frame, b: Frame) -> bool:
    """Whether two frames show the same bytes."""
    return a.image.shape == b.image.shape and np.array_equal(a.image, b.image)
