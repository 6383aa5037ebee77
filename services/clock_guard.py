"""Guard against clock jumps: nothing is deleted by age until the clock has been consistent for some time."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

log = logging.getLogger(__name__)
FILE = "clock.json"
JUMP_S = 86_400.0
"""Clock step or service pause in seconds, beyond which ages are not trusted."""
CONFIRM_S = 86_400.0
"""Seconds of running without another step after which ages are trusted again."""
WRITE_S = 600.0


class ClockGuard:
    """Detector of clock jumps during and between runs of the service. Thread-safe.

    `clock.json` in the data folder stores the time. While the clock is not trusted, the file keeps
    the last trusted time, so a restart does not confirm a wrong clock. Deleting the file and
    starting the service confirms the clock at once.
    """

    def __init__(
        self,
        folder: Path,
        *,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._path, self._wall, self._monotonic = folder / FILE, wall, monotonic
        self._lock = threading.Lock()
        self._looked = wall(), monotonic()
        self._written_s: float | None = None
        self._since_s: float | None = None
        """Monotonic time of the jump; None while the clock is trusted."""
        seen = self._read()
        if seen is not None and self._looked[0] - seen > JUMP_S:
            self._doubt(self._looked[0] - seen, "since the service last ran")

    @property
    def doubt(self) -> str | None:
        """Check the clock. Return the reason while it is not trusted, otherwise None."""
        with self._lock:
            self._look()
            if self._since_s is None:
                return None
            left_h = max(0.0, CONFIRM_S - (self._monotonic() - self._since_s)) / 3600
            return (
                f"the clock has jumped or the service stood still for long: nothing is removed by age for {left_h:.1f} h;"
                f" set the clock right, or remove {FILE} and start the service to confirm it"
            )

    def trusts_ages(self) -> bool:
        """Return True if data may be deleted by age."""
        return self.doubt is None

    def _look(self) -> None:
        wall_s, mono_s = self._wall(), self._monotonic()
        stepped_s = (wall_s - self._looked[0]) - (mono_s - self._looked[1])
        self._looked = wall_s, mono_s
        if abs(stepped_s) > JUMP_S:
            self._doubt(stepped_s, "while the service runs")
        elif self._since_s is not None and mono_s - self._since_s >= CONFIRM_S:
            log.warning("the clock has been consistent for %.0f h: ages are believed again", CONFIRM_S / 3600)
            self._since_s = None
        if self._since_s is None and (self._written_s is None or mono_s - self._written_s >= WRITE_S):
            self._write(wall_s)
            self._written_s = mono_s

    def _doubt(self, step_s: float, when: str) -> None:
        log.error("the clock went on by %.1f days %s: nothing is removed by age for now", step_s / 86_400, when)
        self._since_s = self._monotonic()

    def _read(self) -> float | None:
        """Return the stored time in seconds; None if the file does not exist. A damaged file gives a time that lets the
        clock count as jumped."""
        try:
            return float(json.loads(self._path.read_bytes())["seen_s"])
        except FileNotFoundError:
            pass
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            log.error("%s cannot be read: %s; ages are not believed for now", self._path, error)
            return -JUMP_S
        return None

    def _write(self, wall_s: float) -> None:
        new = self._path.with_suffix(".new")
        try:
            descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "w") as file:
                json.dump({"seen_s": wall_s}, file)
            os.replace(new, self._path)
        except OSError as error:
            log.warning("the time cannot be kept in %s: %s", self._path, error)
