"""One line of JSON for each displayed frame, on disk: the run in full detail, without memory that grows with it."""

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
"""Entries of a report's series; a longer run is summed up in bins of equally many frames."""

Value = float | int | bool | str | None
Entry = dict[str, Value]


class FrameLog:
    """Appends entries to a file, each as one line and with one call of the system: whenever the program is killed, every line but
    possibly the last is whole. A power failure may take lines that the system had not written yet.
    """

    def __init__(self, path: Path, reserve: StorageReserve | None = None) -> None:
        """reserve: room that must stay free on the disk."""
        self.path = path
        self.reserve = reserve
        self._file: BinaryIO | None = None

    def open(self) -> None:
        """Begin an empty file. Raises StorageFull, OutputError."""
        self.close()
        with storage_errors(self.path.parent):
            # Whatever has the name, a link among it, is replaced and not written through.
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
        """The report's series of a run of so many frames, and how many of them one entry sums up."""
        per_entry = frames_per_entry(frames, MAX_SERIES)
        return (tuple(series(read_frames(self.path), per_entry)) if frames else ()), per_entry

    def close(self) -> None:
        """Finish the file. Closing twice is allowed."""
        if self._file is not None:
            self._file.close()
            self._file = None


def read_frames(path: Path) -> Iterator[Entry]:
    """The entries of a log, one at a time. A last line that was cut off is left out. A file that is not there has none."""
    try:
        lines = open_regular(path)
    except FileNotFoundError:
        return
    with lines:
        for line in lines:
            if line.endswith(b"\n"):
                yield json.loads(line)


def frames_per_entry(frames: int, most: int) -> int:
    """How many of `frames` frames one entry of a series sums up, so that there are at most `most` bins."""
    return max(1, -(-frames // most))


def series(entries: Iterable[Entry], per_entry: int) -> Iterator[Entry]:
    """The entries themselves, or one for each `per_entry` of them: the means of their measures.

    A bin has the `seq`, `time_s` and `model_version` of its first frame, how many `frames` it sums up, and `psnr_tissue_min_db`, the worst
    of them. Frames that were trained on and frames that were held out are never summed up together: a bin with both gives two entries.
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
