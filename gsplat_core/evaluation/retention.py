"""What a model still knows at the end: the last seconds of a stream rendered again, and places that were seen twice."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.baselines import BaselineScore
from gsplat_core.evaluation.pictures import Picture
from gsplat_core.evaluation.places import PlaceFinder, Range, Visits
from gsplat_core.evaluation.scores import Entry, Record, Score, ScoreSums, measures, number, why_left_out
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import ScoredMean, psnrs_db

LAST_S = 5.0
FOUND_DB = 33.0
"""From this tissue PSNR on a place that was left counts as found again."""
FIRST_FRAMES = 3


@dataclass(frozen=True)
class PlaceScore:
    """A place that was seen twice, rendered by the final model at the times and poses of each stay."""

    visits: Visits
    first: Score
    again: Score


@dataclass(frozen=True)
class Retention:
    """What the final model scores on frames that it saw long ago."""

    last: Score
    """On the last seconds of the stream."""
    last_range_s: Range
    frozen: BaselineScore
    """The stream's last frame shown for all of these seconds."""
    places: tuple[PlaceScore, ...]


def evaluate_retention(
    frames: Iterable[Frame],
    picture_of: Callable[[Frame], Picture],
    *,
    window_s: tuple[float, float],
    last_s: float = LAST_S,
    places: Sequence[Visits] = (),
    record: Record | None = None,
) -> Retention:
    """Render frames again with the final model and compare; reads the frames twice.

    Args:
        frames: of the recording, in order, each time they are iterated.
        picture_of: what the final model shows for a frame.
        window_s: first and last time that the model has seen; the last seconds are the end of it.
        last_s: how many seconds.
        places: stays at places, as `PlaceFinder` finds them.
        record: given the figures of each scored frame of the last seconds.

    Raises InvalidInput when `frames` can be read only once.
    """
    if isinstance(frames, Iterator):
        raise InvalidInput("evaluate_retention reads the frames twice: pass the recording itself, not an iterator")
    tail = max(window_s[0], window_s[1] - last_s), window_s[1]
    last = ScoreSums()
    visits = [(place, ScoreSums(), ScoreSums()) for place in places]
    newest: Frame | None = None
    for frame in frames:
        wanted = [last] if _within(frame, tail) else []
        for place, first, again in visits:
            wanted += [sums for stay, sums in ((place.first, first), (place.again, again)) if _within(frame, stay)]
        reason = why_left_out(frame)
        if not wanted or reason is not None:
            for sums in wanted:
                sums.leave_out(str(reason))
            continue
        if last in wanted:
            newest = frame
        picture = picture_of(frame)
        for sums in wanted:
            quality = sums.add(frame, picture.image)
            if sums is last and record is not None:
                own = {
                    "seq": frame.seq,
                    "time_s": frame.time_s,
                    "trained": True,
                    "model_version": picture.model_version,
                }
                record({**own, **measures(quality)})
    return Retention(
        last=last.score,
        last_range_s=tail,
        frozen=_frozen(frames, newest, tail),
        places=tuple(PlaceScore(place, first.score, again.score) for place, first, again in visits),
    )


def find_places(frames: Iterable[Frame]) -> list[Visits]:
    """The places that the scope of a recording came back to, by the poses of its frames; none where they have no poses."""
    finder = PlaceFinder()
    for frame in frames:
        if frame.pose is not None:
            finder.add(frame.time_s, frame.pose)
    return finder.visits()


@dataclass(frozen=True)
class Return:
    """How soon a place was found again when the scope came back, in another protocol's figures."""

    visits: Visits
    first_db: tuple[float | None, ...]
    """Tissue PSNR of the first frames of the second stay."""
    frames_until_found: int | None
    """The number, from 1, of the first of its frames that scored `FOUND_DB` or more; None where none did."""


def returns(entries: Iterable[Entry], places: Sequence[Visits]) -> list[Return]:
    """Read from the log of a live or causal evaluation how good the first frames of each return were."""
    first: list[list[float | None]] = [[] for _ in places]
    count, found = [0] * len(places), [None] * len(places)  # type: list[int], list[int | None]
    for entry in entries:
        value, time_s = number(entry, "psnr_tissue_db"), number(entry, "time_s")
        for k, place in enumerate(places):
            if time_s is None or not place.again[0] <= time_s <= place.again[1]:
                continue
            count[k] += 1
            if len(first[k]) < FIRST_FRAMES:
                first[k].append(value)
            if found[k] is None and value is not None and value >= FOUND_DB:
                found[k] = count[k]
    return [Return(place, tuple(first[k]), found[k]) for k, place in enumerate(places)]


def _within(frame: Frame, times: Range) -> bool:
    # Seconds are made of nanoseconds by a product that rounds.
    return times[0] - 1e-6 <= frame.time_s <= times[1] + 1e-6


def _frozen(frames: Iterable[Frame], shown: Frame | None, tail: Range) -> BaselineScore:
    """What one picture scores on every frame of a range of time but itself."""
    tissue, whole = ScoredMean(), ScoredMean()
    for frame in frames if shown is not None else ():
        assert shown is not None
        if _within(frame, tail) and frame.seq != shown.seq and why_left_out(frame) is None:
            tissue_db, frame_db = psnrs_db(shown.image, frame.image, frame.mask)
            tissue.add(tissue_db)
            whole.add(frame_db)
    return BaselineScore(tissue.mean, whole.mean, tissue.count)
