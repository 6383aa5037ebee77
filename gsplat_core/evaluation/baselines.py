"""Trivial baselines of a reconstruction: frame copies, frame means, and optical flow.

A copy of the previous frame is a strong baseline in slow endoscopy. A reconstruction that scores
lower adds nothing to a frozen video. The recording is read twice, with at most ten frames and one
sum in memory. Frames are held out by `Frame.seq`. Damaged and withheld frames are neither scored nor part of the mean
of the training frames. Where numbers are missing or pictures cannot be shown (`Frame.can_be_shown`), the previous frame is the last
one that arrived and could be shown.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from os import cpu_count
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.scores import BaselineScore, Entry, Record, finite, why_left_out
from gsplat_core.io.recordings.recording import is_heldout
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import ImageLike, ScoredMean, psnr_tissue_db, psnrs_db, unit_image

SMALLEST_SIDE_PX = 12
"""Shortest image side in pixels for which optical flow is computed."""
_per_thread = threading.local()


def half_velocity(before_last: NDArray[np.uint8], last: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """Predict the next picture by moving the last one by half of the last motion; causal.

    Half of the motion scores better than all of it, because the estimated flow is uncertain.

    Args:
        before_last: RGB uint8 [H, W, 3].
        last: RGB uint8 [H, W, 3], the frame after `before_last`.

    Returns:
        float32 [H, W, 3] in 0..1, or None if the pictures are too small for the flow.
    """
    backward = _flow(last, before_last)
    return None if backward is None else _moved(last, backward, 0.5)


def half_way(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """Interpolate the picture between two frames: the mean of both, each moved half-way to the other.

    Non-causal. Arguments and result are those of `half_velocity`.
    """
    forward, backward = _flow(before, after), _flow(after, before)
    if forward is None or backward is None:
        return None
    return (_moved(before, forward, -0.5) + _moved(after, backward, -0.5)) / np.float32(2)


def _flow(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """Return the optical flow from `source` to `target` as offsets [H, W, 2] in pixels; None for pictures smaller than
    `SMALLEST_SIDE_PX`.
    """
    if min(source.shape[:2]) < SMALLEST_SIDE_PX:
        return None
    finder = getattr(_per_thread, "finder", None)
    if finder is None:
        # The flow finder keeps buffers between calls, so each thread has its own.
        finder = _per_thread.finder = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow: Any = finder.calc(_grey(source), _grey(target), None)  # type: ignore[call-overload]  # None: a new array, which the stubs leave out
    return np.asarray(flow, np.float32)


def _grey(image: NDArray[np.uint8]) -> Any:
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)


def _moved(image: NDArray[np.uint8], flow: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    height, width = flow.shape[:2]
    x = np.float32(share) * flow[..., 0] + np.arange(width, dtype=np.float32)
    y = np.float32(share) * flow[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    moved = cv2.remap(unit_image(image), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.float32)


AGES = (1, 2, 3, 5, 8)
"""Ages in frames of the copies of earlier frames that are scored for the frame-hold curve (PSNR of a copy by its age)."""
PREVIOUS_FRAME, NEIGHBOUR_MEAN, TRAIN_MEAN = "previous_frame", "neighbour_mean", "train_mean"
HALF_VELOCITY, HALF_WAY = "half_velocity_flow", "half_way_flow"
SEES_THE_FUTURE = frozenset({NEIGHBOUR_MEAN, HALF_WAY})
"""Names of the baselines that use the frame after the scored one, which a live system does not have yet."""
_MAX_THREADS = 4


@dataclass(frozen=True)
class Baselines:
    """Scores of each baseline over tissue pixels of the scored frames."""

    copies: Mapping[int, BaselineScore] = field(default_factory=dict)
    """Scores of copies of an earlier frame, shown in place of each frame, by the copy's age in frames."""
    every: Mapping[str, BaselineScore] = field(default_factory=dict)
    """Scores by baseline name over all frames, not only held-out ones. The only such baseline is `half_velocity_flow`."""
    heldout: Mapping[str, BaselineScore] = field(default_factory=dict)
    """Scores by baseline name over the held-out frames.

    The baselines are the previous frame, the mean of both neighbours and the half-way flow (both
    use the next frame), and the mean of all training frames including their tools.
    """
    left_out: Mapping[str, int] = field(default_factory=dict)
    """Numbers of excluded frames by reason."""

    @property
    def previous_frame_db(self) -> float | None:
        """PSNR in dB of frame i-1 against frame i, over all frames from the second on; baseline of live quality. None
        if no frame was scored.
        """
        return self.copies.get(1, _NOTHING).psnr_tissue_db

    @property
    def heldout_previous_frame_db(self) -> float | None:
        """PSNR in dB of frame i-1 against held-out frame i; None if no frame was scored."""
        return self.heldout.get(PREVIOUS_FRAME, _NOTHING).psnr_tissue_db

    @property
    def heldout_neighbour_mean_db(self) -> float | None:
        """PSNR in dB of the mean of frames i-1 and i+1 against held-out frame i, non-causal; None if no frame was
        scored.
        """
        return self.heldout.get(NEIGHBOUR_MEAN, _NOTHING).psnr_tissue_db

    @property
    def heldout_train_mean_db(self) -> float | None:
        """PSNR in dB of the mean of all training frames against every held-out frame; None if no frame was scored."""
        return self.heldout.get(TRAIN_MEAN, _NOTHING).psnr_tissue_db


_NOTHING = BaselineScore()


def measure_baselines(
    recording: Iterable[Frame], *, ages: Sequence[int] = (1,), flow: bool = False, record: Record | None = None
) -> Baselines:
    """Score the trivial baselines on a recording; reads it twice.

    Args:
        recording: re-iterable recording that yields its frames in order. Frames need not have a mask.
        ages: ages of the copies in frames; 1 is always added.
        flow: also score the two baselines that need optical flow, which take about 50 ms per frame of 640x512 pixels.
        record: callback that receives each frame's figures in order, without those of the train mean.

    Raises:
        InvalidInput: if the recording can be iterated only once, its frames differ in size, or an age is below 1.
    """
    if isinstance(recording, Iterator):
        raise InvalidInput(
            "measure_baselines reads the frames twice: pass the recording itself, not an iterator over it"
        )
    ages = sorted({1, *ages})
    if ages[0] < 1:
        raise InvalidInput(f"ages are {list(ages)}; a copy is at least one frame old")
    sums = _Sums()
    train_mean = _TrainMean()
    left_out: Counter[str] = Counter()
    with _Pool() as pool:
        for frame, before, after in _neighbourhoods(recording, max(2, ages[-1])):
            reason = why_left_out(frame)
            if reason is not None:
                left_out[reason] += 1
            if not is_heldout(frame.seq) and reason in (None, "no tissue"):
                train_mean.add(frame.image)
            if reason is None and before:
                pool.put(_compare, (frame, before, after, ages, flow), lambda values: sums.add(values, ages, record))
    mean_image = train_mean.image()
    for frame in recording if mean_image is not None else ():
        if is_heldout(frame.seq) and why_left_out(frame) is None:
            sums.take(("heldout", TRAIN_MEAN), *psnrs_db(mean_image, frame.image, frame.tissue))  # type: ignore[arg-type]
    return sums.baselines(ages, left_out)


@dataclass(frozen=True)
class _Values:
    """PSNR of the baselines on one frame, by baseline name: over tissue, over the whole frame, and for copies over
    pixels that are tissue in both pictures.
    """

    frame: Frame
    by_key: dict[tuple[str, object], tuple[float, ...]]

    def entry(self, ages: Sequence[int]) -> Entry:
        """Return the log entry of the frame: the PSNR in dB of each baseline; all entries have the same keys.

        `psnr_tissue_db` is that of the copy of the previous frame.
        """
        frame = self.frame
        value = lambda group, name: finite(self.by_key[group, name][0]) if (group, name) in self.by_key else None
        return {
            "seq": frame.seq,
            "time_s": frame.time_s,
            "trained": False,
            "model_version": 0,
            "psnr_tissue_db": value("copies", 1),
            **{f"copy_{age}_db": value("copies", age) for age in ages},
            f"{HALF_VELOCITY}_db": value("every", HALF_VELOCITY),
            **{f"{name}_db": value("heldout", name) for name in (PREVIOUS_FRAME, NEIGHBOUR_MEAN, HALF_WAY)},
        }


def _compare(frame: Frame, before: Sequence[Frame], after: Frame | None, ages: Sequence[int], flow: bool) -> _Values:
    """Score the baselines of one frame; `before` contains the preceding frames, newest first."""
    found: dict[tuple[str, object], tuple[float, ...]] = {}

    def score(group: str, name: object, picture: ImageLike | None) -> None:
        if picture is not None:
            found[group, name] = psnrs_db(picture, frame.image, frame.tissue)

    for age in ages:
        if age <= len(before):
            old = before[age - 1]
            score("copies", age, old.image)
            found["copies", age] += (psnr_tissue_db(old.image, frame.image, _tissue_in_both(frame, old)),)
    if flow and len(before) > 1:
        score("every", HALF_VELOCITY, half_velocity(before[1].image, before[0].image))
    if is_heldout(frame.seq):
        score("heldout", PREVIOUS_FRAME, before[0].image)
        if after is not None:
            score("heldout", NEIGHBOUR_MEAN, (before[0].image.astype(np.float32) + after.image) / np.float32(2 * 255))
            if flow:
                score("heldout", HALF_WAY, half_way(before[0].image, after.image))
    return _Values(frame, found)


def _tissue_in_both(frame: Frame, other: Frame) -> NDArray[np.uint8] | None:
    if frame.tissue is None or other.tissue is None:
        return other.tissue if frame.tissue is None else frame.tissue
    return ((frame.tissue != 0) & (other.tissue != 0)).astype(np.uint8)


def _neighbourhoods(recording: Iterable[Frame], most: int) -> Iterator[tuple[Frame, list[Frame], Frame | None]]:
    """Yield each frame with up to `most` preceding frames, newest first, and the next frame, None for the last one.

    Frames that cannot be shown are yielded without others, and are not among those of other frames.
    """
    window: deque[Frame] = deque(maxlen=most + 2)
    for frame in recording:
        if window and window[-1].image.shape != frame.image.shape:
            raise InvalidInput(
                f"frame {frame.seq} is {list(frame.image.shape)}, the one before it {list(window[-1].image.shape)}; they must be equal"
            )
        if not frame.can_be_shown:
            yield frame, [], None
            continue
        window.append(frame)
        if len(window) > 1:
            yield window[-2], list(window)[-3::-1], frame
    if window:
        yield window[-1], list(window)[-2::-1][:most], None


class _Sums:
    """Accumulator of the mean PSNRs of each baseline over the added frames."""

    def __init__(self) -> None:
        self._means: dict[tuple[str, object], tuple[ScoredMean, ...]] = {}

    def take(self, key: tuple[str, object], *values: float) -> None:
        for mean, value in zip(
            self._means.setdefault(key, (ScoredMean(), ScoredMean(), ScoredMean())), values, strict=False
        ):
            mean.add(value)

    def add(self, values: _Values, ages: Sequence[int], record: Record | None) -> None:
        for key, measured in values.by_key.items():
            self.take(key, *measured)
        if record is not None:
            record(values.entry(ages))

    def baselines(self, ages: Sequence[int], left_out: Mapping[str, int]) -> Baselines:
        scores: dict[str, dict[Any, BaselineScore]] = {"copies": {age: _NOTHING for age in ages}}
        for (group, name), (tissue, frame, both) in self._means.items():
            score = BaselineScore(tissue.mean, frame.mean, tissue.count, both.mean)
            scores.setdefault(group, {})[name] = score
        return Baselines(
            scores["copies"], scores.get("every", {}), scores.get("heldout", {}), dict(sorted(left_out.items()))
        )


class _Pool:
    """Bounded thread pool that returns results in order.

    OpenCV and torch release the interpreter lock during the comparison.
    """

    def __init__(self) -> None:
        self._threads = min(_MAX_THREADS, cpu_count() or 1)
        self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="baselines")
        self._pending: deque[tuple[Future[Any], Callable[[Any], None]]] = deque()

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            while kind is None and self._pending:
                self._take()
        finally:
            self._pool.shutdown(cancel_futures=True)

    def put(self, work: Callable[..., Any], arguments: tuple[Any, ...], done: Callable[[Any], None]) -> None:
        """Submit `work(*arguments)` to the pool; `done` receives the results in order of submission."""
        self._pending.append((self._pool.submit(work, *arguments), done))
        if len(self._pending) > 2 * self._threads:
            self._take()

    def _take(self) -> None:
        future, done = self._pending.popleft()
        done(future.result())


class _TrainMean:
    """Running mean of images. Sums are exact 32-bit integers, which do not overflow up to 2^24 frames."""

    def __init__(self) -> None:
        self._sum: NDArray[np.uint32] | None = None
        self._count = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        if self._sum is None:
            self._sum = np.zeros(image.shape, np.uint32)
        self._sum += image
        self._count += 1

    def image(self) -> NDArray[np.float32] | None:
        """Mean of the added images, RGB in 0..1; None without any image."""
        if self._sum is None:
            return None
        return (self._sum / (255.0 * self._count)).astype(np.float32)
