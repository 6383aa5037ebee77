"""On-disk log with one line of JSON per displayed frame, so that memory use does not grow with the stream.

The module also reads logs, averages their entries in bins, and computes the scores of live runs from them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.evaluation.scores import NOTHING_SHOWN, Entry, Live, LiveSums, Record, number
from gsplat_core.io.files import open_regular
from gsplat_core.training.metrics import MEASURES, FrameQuality
from operators.storage import StorageReserve, storage_errors

FRAMES_FILE = "frames.jsonl"
MAX_SERIES = 4096
"""Maximum number of entries of a report's series. Longer runs are averaged in bins of equal size."""
Value = float | int | bool | str | None
LogLine = dict[str, Value]


class FrameLog:
    """Appends entries to a file, each as one line in a single write call.

    If the process is killed, all lines but possibly the last are complete. A power failure may lose
    lines that the operating system had not written to disk.
    """

    def __init__(self, path: Path, reserve: StorageReserve | None = None) -> None:
        """Set the path without opening the file.

        Args:
            path: the log file.
            reserve: free disk space to be kept; None for no check.
        """
        self.path = path
        self.reserve = reserve
        self._file: BinaryIO | None = None

    def open(self) -> None:
        """Create an empty file, replacing an existing one. Raises StorageFull, OutputError."""
        self.close()
        with storage_errors(self.path.parent):
            # Replace an existing file or link rather than write through it.
            self.path.unlink(missing_ok=True)
            self._file = self.path.open("xb", buffering=0)

    def write(self, entry: Mapping[str, Value]) -> None:
        """Append one entry. Raises StorageFull, OutputError."""
        if self._file is None:
            raise InvalidInput(f"{self.path} is not open; call open() first")
        line = (json.dumps(entry, allow_nan=False, separators=(",", ":")) + "\n").encode()
        if self.reserve is not None:
            self.reserve.require(len(line))
        with storage_errors(self.path.parent):
            self._file.write(line)

    def series(self, frames: int) -> tuple[tuple[LogLine, ...], int]:
        """Return the report's series for a run of `frames` frames, and the number of frames per entry."""
        per_entry = frames_per_entry(frames, MAX_SERIES)
        return (tuple(series(read_frames(self.path), per_entry)) if frames else ()), per_entry

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._file is not None:
            self._file.close()
            self._file = None


def read_frames(path: Path) -> Iterator[LogLine]:
    """Yield the entries of a log. A truncated last line is skipped. A missing file yields nothing."""
    try:
        lines = open_regular(path)
    except FileNotFoundError:
        return
    with lines:
        for line in lines:
            if line.endswith(b"\n"):
                yield json.loads(line)


def frames_per_entry(frames: int, most: int) -> int:
    """Return the number of frames per bin that reduces `frames` frames to at most `most` bins."""
    return max(1, -(-frames // most))


def series(entries: Iterable[LogLine], per_entry: int) -> Iterator[LogLine]:
    """Yield the entries unchanged, or the mean measures of each bin of `per_entry` entries.

    A bin has the `seq`, `time_s` and `model_version` of its first frame, the number of `frames` and
    their lowest PSNR, `psnr_tissue_min_db`. Trained and held-out frames are averaged separately, so
    a bin with both kinds yields two entries.
    """
    if per_entry == 1:
        yield from entries
        return
    bins: dict[bool, list[LogLine]] = {}
    for k, entry in enumerate(entries):
        if k % per_entry == 0:
            yield from _summed_up(bins)
            bins = {}
        bins.setdefault(bool(entry["trained"]), []).append(entry)
    yield from _summed_up(bins)


def _summed_up(bins: Mapping[bool, list[LogLine]]) -> Iterator[LogLine]:
    for frames in bins.values():
        means = {
            name: _mean(frames, name) for name, value in frames[0].items() if name.endswith("_db") or name == "ssim"
        }
        worst = [value for entry in frames if (value := entry["psnr_tissue_db"]) is not None]
        yield {**frames[0], **means, "frames": len(frames), "psnr_tissue_min_db": min(worst, default=None)}


def _mean(frames: list[LogLine], name: str) -> float | None:
    values = [value for entry in frames if isinstance(value := entry[name], (int, float))]
    return math.fsum(values) / len(values) if values else None


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
    """Return True if a run's log has display times. Raise InvalidSetting if the file is not a log."""
    first = next(_entries(path), None)
    return first is not None and "shown_ns" in first and "arrived_ns" in first


def read_live_log(path: Path, record: Record | None = None) -> Live:
    """Compute the scores of the live protocol from a run's log.

    The run scored the pictures when they were displayed (`MetricsOp`). The last frame is
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
