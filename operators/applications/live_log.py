"""Reader for the log of a live run, which records the picture on display when each next frame
arrived.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from gsplat_core.errors import InvalidSetting
from gsplat_core.evaluation.live import NOTHING_SHOWN, Live, LiveSums
from gsplat_core.evaluation.scores import Entry, Record, number
from gsplat_core.training.metrics import MEASURES, FrameQuality
from operators.frame_log import read_frames

NOT_SCORED, NO_FIGURE = "too fast to be scored", "damaged or without tissue"
_NS_PER_MS = 1e6


@dataclass(frozen=True)
class _Line:
    """A frame with the score and timing of the picture on display when the next frame arrived."""

    seq: int
    time_s: float
    arrived_ns: int
    shown_seq: int
    shown_ns: int
    age_ms: float
    """Age of the picture at display, in milliseconds."""
    state: str
    withheld: str | None
    previous_frame_db: float
    """Tissue PSNR in dB of the previous raw frame; NaN if not measured."""
    quality: FrameQuality


def is_live_log(path: Path) -> bool:
    """Return True if a run's log has display times. Raise InvalidSetting if the file is not a
    log.
    """
    first = next(_entries(path), None)
    return first is not None and "shown_ns" in first and "arrived_ns" in first


def read_live_log(path: Path, record: Record | None = None) -> Live:
    """Compute the scores of the live protocol from a run's log.

    The run scored the pictures when they were displayed (`OnScreenMetricsOp`). The last frame is
    excluded, because its display duration is unknown.

    Args:
        path: the log file.
        record: called with the scores of each frame.

    Raises:
        InvalidSetting: a line is not an entry of a live log.
    """
    sums = LiveSums(record)
    last_shown: tuple[int, int] | None = None
    started = False
    for line, following in pairwise(_lines(path)):
        if not started:
            for _ in range(line.seq):
                sums.leave_out(NOTHING_SHOWN)
            started = True
        shown = line.shown_seq, line.shown_ns
        if shown != last_shown:
            sums.picture(line.age_ms, line.state)
            last_shown = shown
        if line.withheld is not None:
            sums.leave_out("withheld")
        elif not math.isfinite(line.quality.psnr_tissue_db):
            sums.leave_out(NO_FIGURE)
        else:
            content_ns = line.shown_ns - line.age_ms * _NS_PER_MS
            on_screen_ms = (following.arrived_ns - content_ns) / _NS_PER_MS
            before_db = line.previous_frame_db, math.nan
            sums.frame(line.quality, line.time_s, line.seq - line.shown_seq, on_screen_ms, before_db)
        for _ in range(following.seq - line.seq - 1):
            sums.leave_out(NOT_SCORED)
    return sums.live


def _lines(path: Path) -> Iterator[_Line]:
    before: _Line | None = None
    for entry in _entries(path):
        seq = _whole(entry, "seq", path)
        line = _Line(
            seq=seq,
            time_s=_finite(entry, "time_s", path),
            arrived_ns=_whole(entry, "arrived_ns", path),
            shown_seq=_whole(entry, "shown_seq", path) if "shown_seq" in entry else seq,
            shown_ns=_whole(entry, "shown_ns", path),
            age_ms=_finite(entry, "age_ms", path),
            state=str(entry.get("state", "live")),
            withheld=None if entry.get("withheld") is None else str(entry["withheld"]),
            previous_frame_db=_measure(entry, "previous_frame_db"),
            quality=FrameQuality(seq, *(_measure(entry, name) for name in MEASURES)),
        )
        if before is not None and (seq <= before.seq or line.arrived_ns < before.arrived_ns):
            raise InvalidSetting(
                f"{path}: frame {seq} comes after frame {before.seq} and arrived at {line.arrived_ns} ns after {before.arrived_ns} ns; the log"
                " of a live run is in order"
            )
        yield line
        before = line


def _entries(path: Path) -> Iterator[Entry]:
    try:
        for entry in read_frames(path):
            if not isinstance(entry, dict):
                raise InvalidSetting(f"{path} has a line that holds no figures by name; it is not the log of a run")
            yield entry
    except (ValueError, RecursionError) as error:
        if isinstance(error, InvalidSetting):
            raise
        raise InvalidSetting(f"{path} is not the log of a run: {error}") from error


def _measure(entry: Entry, name: str) -> float:
    value = number(entry, name)
    return math.nan if value is None else value


def _whole(entry: Entry, name: str, path: Path) -> int:
    value = entry.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) >= 1 << 63:
        raise InvalidSetting(
            f"{path} has a line whose {name} is {value!r}; it must be a whole number: it is not the log of a live run"
        )
    return value


def _finite(entry: Entry, name: str, path: Path) -> float:
    value = number(entry, name)
    if value is None or not math.isfinite(value):
        raise InvalidSetting(f"{path} has a line whose {name} is {entry.get(name)!r}; it must be a number")
    return value
