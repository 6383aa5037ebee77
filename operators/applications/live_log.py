"""What a live run's log says about when frames arrived and what was shown when."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import count
from pathlib import Path

from gsplat_core.errors import InvalidSetting
from gsplat_core.evaluation.live import Shown
from gsplat_core.scene.frames import Frame
from operators.frame_log import Entry, read_frames


def is_live_log(path: Path) -> bool:
    """Whether a run's log says when its pictures were shown."""
    first = next(read_frames(path), None)
    return first is not None and "shown_ns" in first and "arrived_ns" in first


def shown_pictures(path: Path) -> Iterator[Shown]:
    """The pictures of a live run in the order in which they were shown. The log has their figures, not the pictures themselves."""
    for entry in read_frames(path):
        psnr_db = entry.get("psnr_tissue_db")
        yield Shown(
            seq=_whole(entry, "seq", path),
            arrived_ns=_whole(entry, "arrived_ns", path),
            shown_ns=_whole(entry, "shown_ns", path),
            psnr_tissue_db=None if psnr_db is None else float(psnr_db),
            state=str(entry.get("state", "live")),
        )


def live_frames(recording: Iterable[Frame], log: Path) -> Iterator[Frame]:
    """The frames of a live run, with the times at which they arrived: those of the recording that it played, again from the beginning where
    it was looped.

    A frame that was dropped has no line in the log: its arrival is put between those of its neighbours, in proportion to its number.
    """
    arrivals = _arrivals(log)
    before = after = next(arrivals, None)
    for index, frame in zip(count(), _looped(recording), strict=False):
        while after is not None and after[0] < index:
            before, after = after, next(arrivals, None)
        if after is None or before is None:
            return
        if index < before[0]:
            continue  # nothing is known of frames before the first one that was shown
        share = 0.0 if after[0] == before[0] else (index - before[0]) / (after[0] - before[0])
        yield frame.with_fields(seq=index, arrived_ns=round(before[1] + share * (after[1] - before[1])))


def _arrivals(log: Path) -> Iterator[tuple[int, int]]:
    """Number and arrival of each frame that was shown, each once."""
    newest = -1
    for entry in read_frames(log):
        seq = _whole(entry, "seq", log)
        if seq > newest:
            newest = seq
            yield seq, _whole(entry, "arrived_ns", log)


def _looped(recording: Iterable[Frame]) -> Iterator[Frame]:
    """The frames again and again; time goes on from one round to the next."""
    offset_ns = 0
    while True:
        first = last = before = None
        for frame in recording:
            first, before, last = first or frame, last, frame
            yield frame.with_fields(pts_ns=frame.pts_ns + offset_ns)
        if first is None or last is None or before is None:
            return
        offset_ns += last.pts_ns - first.pts_ns + (last.pts_ns - before.pts_ns)


def _whole(entry: Entry, name: str, path: Path) -> int:
    value = entry.get(name)
    if not isinstance(value, int) or isinstance(value, bool):
        raise InvalidSetting(
            f"{path} has a line whose {name} is {value!r}; it must be a whole number: it is not the log of a live run"
        )
    return value
