"""On-disk log with one line of JSON per displayed frame, so that memory use does not grow with the
run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from gsplat_core.errors import InvalidInput
from gsplat_core.io.files import open_regular
from operators.storage import StorageReserve, storage_errors

FRAMES_FILE = "frames.jsonl"
MAX_SERIES = 4096
"""Maximum number of entries of a report's series. Longer runs are averaged in bins of equal
size.
"""

Value = float | int | bool | str | None
Entry = dict[str, Value]


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

    def series(self, frames: int) -> tuple[tuple[Entry, ...], int]:
        """Return the report's series for a run of `frames` frames, and the number of frames per
        entry.
        """
        per_entry = frames_per_entry(frames, MAX_SERIES)
        return (tuple(series(read_frames(self.path), per_entry)) if frames else ()), per_entry

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._file is not None:
            self._file.close()
            self._file = None


def read_frames(path: Path) -> Iterator[Entry]:
    """Yield the entries of a log. A truncated last line is skipped. A missing file yields
    nothing.
    """
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


def series(entries: Iterable[Entry], per_entry: int) -> Iterator[Entry]:
    """Yield the entries unchanged, or the mean measures of each bin of `per_entry` entries.

    A bin has the `seq`, `time_s` and `model_version` of its first frame, the number of `frames` and
    their lowest PSNR, `psnr_tissue_min_db`. Trained and held-out frames are averaged separately, so
    a bin with both kinds yields two entries.
    """
    if per_entry == 1:
        yield from entries
        return
    bins: dict[bool, list[Entry]] = {}
    for k, entry in enumerate(entries):
        if k % per_entry == 0:
            yield from _summed_up(bins)
            bins = {}
        bins.setdefault(bool(entry["trained"]), []).append(entry)
    yield from _summed_up(bins)


def _summed_up(bins: Mapping[bool, list[Entry]]) -> Iterator[Entry]:
    for frames in bins.values():
        means = {
            name: _mean(frames, name) for name, value in frames[0].items() if name.endswith("_db") or name == "ssim"
        }
        worst = [value for entry in frames if (value := entry["psnr_tissue_db"]) is not None]
        yield {**frames[0], **means, "frames": len(frames), "psnr_tissue_min_db": min(worst, default=None)}


def _mean(frames: list[Entry], name: str) -> float | None:
    values = [value for entry in frames if isinstance(value := entry[name], (int, float))]
    return math.fsum(values) / len(values) if values else None
