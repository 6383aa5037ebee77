"""Repair of sequence numbers and timestamps of external senders."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gsplat_core.scene.frames import Frame

RESET_S = 1.0
"""Backward step of a sender's timestamp, in seconds, that counts as a restart rather than a late
frame.
"""
JUMP_S = 2.0
"""Excess of a sender's timestamp step over the local clock, in seconds, that counts as a clock
change.
"""
MOST_LOST = 1_000_000
"""Gap in sequence numbers above which a restart is assumed instead of lost frames."""
RESET_FRAMES = 3
"""Number of consecutive late frames, in order among themselves, that count as a restarted
sender.
"""


class FrameOrder:
    """Produces increasing `seq` and `pts_ns` from any sender.

    Duplicate and late frames are dropped. If a sender restarts or its clock is changed, numbers and
    timestamps continue; the step between the two frames is measured with the local clock. All
    repairs are counted.
    """

    def __init__(self, *, trusted: bool = False) -> None:
        """trusted: the sender repeats no frame and keeps the order; only `restart` is handled."""
        self._trusted = trusted
        self._counts: Counter[str] = Counter()
        self.begin()

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of repairs by reason: `duplicates`, `out_of_order`, `missing`, `clock_resets`,
        `clock_jumps`, `repaired_times`.
        """
        return self._counts

    def begin(self) -> None:
        """Reset everything; the next frame gets number 0 and time 0."""
        self._counts.clear()
        self._out: Frame | None = None  # last frame, as passed on
        self._in: Frame | None = None  # last frame, as received
        self._arrived_ns = 0
        self._seq_offset = self._pts_offset_ns = 0
        self._late: Frame | None = None
        self._late_count = 0
        self._restarted = False

    def restart(self) -> None:
        """Continue numbers and timestamps with the next frame, which arrives over a new
        connection.
        """
        self._restarted = True

    def take(self, frame: Frame, arrived_ns: int) -> Frame | None:
        """Return the frame with repaired number and timestamp; None to drop it.

        Args:
            frame: the received frame.
            arrived_ns: its arrival by the local monotonic clock, in nanoseconds.
        """
        known, out = self._in, self._out
        if known is None:
            if not self._trusted:
                # Start at 0, because large timestamps lose precision in float32.
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
        """Return True if the recent late frames form a consecutive stream, so that the sender has
        restarted.
        """
        late = self._late
        goes_on = late is not None and frame.seq > late.seq and frame.pts_ns >= late.pts_ns
        self._late_count = self._late_count + 1 if goes_on else 1
        self._late = frame
        return self._late_count >= RESET_FRAMES

    def _rebase(self, frame: Frame, arrived_ns: int, reason: str | None) -> Frame:
        """Continue with the next number, and with the time elapsed on the local clock since the
        last frame.
        """
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
    """Return True if both frames have identical pixels."""
    return a.image.shape == b.image.shape and np.array_equal(a.image, b.image)
