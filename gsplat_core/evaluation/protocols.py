"""Offline protocols that render a model for the frames of a recording and score the pictures.

* `evaluate_heldout`: frames excluded from training, rendered from a finished model
* `evaluate_causal`: each frame is predicted before it is trained on, from its time and pose
* `evaluate_retention`: earlier frames and revisited places, rendered from the final model
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.depth import DepthErrors, DepthSums
from gsplat_core.evaluation.scores import (
    BaselineScore,
    Entry,
    Record,
    Score,
    ScoreSums,
    finite,
    measures,
    number,
    why_left_out,
)
from gsplat_core.io.recordings.recording import is_heldout
from gsplat_core.models import Model, Snapshot
from gsplat_core.rendering.renderer import STANDARD_OUTPUTS, Renderer, new_renderer, standard_outputs
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import ScoredMean, psnr_tissue_db, psnrs_db


@dataclass(frozen=True)
class Picture:
    """Rendered picture and its depth in their own memory, which the renderer does not reuse."""

    image: NDArray[np.uint8]
    """RGB [H, W, 3] as displayed: clipped and rounded to 8 bits."""
    unrounded: NDArray[np.float32]
    """RGB [H, W, 3] in 0..1 before the rounding, clipped."""
    depth: NDArray[np.float32]
    """Depth z [H, W] in the model's unit of length; 0 = empty."""
    model_version: int
    ray_depth: NDArray[np.float32] | None = None
    """Depth z [H, W] along the rays, 0 = empty; None if it was not requested or the renderer does not have it."""


class PictureMaker:
    """Renderer of published models at a frame's time and pose; reuses one renderer."""

    def __init__(
        self, camera: Camera, device: torch.device | str = "cpu", renderer: str = "alpha", *, ray_depth: bool = False
    ) -> None:
        """Create the renderer; `camera` is used for frames without a pose of their own.

        Args:
            camera: size and projection of the pictures.
            device: device of the models.
            renderer: name of the renderer.
            ray_depth: True for the depth along the rays too, if the renderer has it.
        """
        self.camera = camera
        capabilities = RENDERERS[renderer].capabilities
        self._reads_snapshots = capabilities.reads_snapshots
        wanted = {*STANDARD_OUTPUTS, *(["ray_depth"] if ray_depth else [])}
        self._outputs = tuple(name for name in capabilities.outputs if name in wanted)
        self._renderer: Renderer = new_renderer(renderer, camera, device)
        self._prepared: Model | Snapshot | None = None

    def __call__(self, model: Model | Snapshot, frame: Frame, camera: Camera | None = None) -> Picture:
        """Render the model for a frame.

        Args:
            model: published model; the frame's time is clamped to its window.
            frame: frame that determines time and pose.
            camera: replaces the frame's camera; must have the same size.
        """
        if camera is None:
            camera = self.camera if frame.pose is None else self.camera.with_pose(frame.pose)
        with torch.inference_mode():
            if model is not self._prepared:
                self._renderer.prepare(model if self._reads_snapshots else model.as_model())
                # Do not keep a snapshot for the next call: while it is referenced, training cannot reuse its slot.
                self._prepared = model if isinstance(model, Model) else None
            found = self._renderer.render(camera, frame.time_s, self._outputs).outputs()
            output, along_rays = standard_outputs(found), found.get("ray_depth")
            picture = output.image.clamp(0, 1)
            rounded = (picture * 255).round().to(torch.uint8)
            return Picture(
                image=np.array(rounded.cpu().numpy()),
                unrounded=np.array(picture.cpu().numpy()),
                depth=np.array(output.depth.cpu().numpy()),
                model_version=model.version,
                ray_depth=None if along_rays is None else np.array(along_rays.cpu().numpy()),
            )


OUTSIDE = "outside of the model's time"


@dataclass(frozen=True)
class HeldOut:
    """Scores of a model on the held-out frames, which were excluded from training."""

    score: Score
    """Score of the pictures rounded to 8 bits, as EndoGaussian measures its PNG files."""
    unrounded_db: float | None
    """Mean tissue PSNR in dB of the pictures before they are rounded; None if no frame was scored."""
    depth: DepthErrors | None
    """Depth errors against the recording's depth; None if it has none."""


def evaluate_heldout(
    frames: Iterable[Frame],
    picture_of: Callable[[Frame], Picture],
    *,
    window_s: tuple[float, float],
    record: Record | None = None,
) -> HeldOut:
    """Score the held-out frames, those with (seq - 1) mod 8 = 0; no other frame is rendered.

    Args:
        frames: frames of the recording in order.
        picture_of: callback that renders the model for a frame.
        window_s: first and last time in seconds that the model was trained on, plus tolerance.
            Frames outside are counted as left out.
        record: callback that receives the figures of each scored frame.

    Returns:
        Image and depth scores.
    """
    sums, unrounded, depth = ScoreSums(), ScoredMean(), DepthSums()
    for frame in frames:
        if not is_heldout(frame.seq):
            continue
        reason = why_left_out(frame)
        if reason is None and not window_s[0] <= frame.time_s <= window_s[1]:
            reason = OUTSIDE
        if reason is not None:
            sums.leave_out(reason)
            continue
        picture = picture_of(frame)
        quality = sums.add(frame, picture.image)
        unrounded_db = psnr_tissue_db(picture.unrounded, frame.image, frame.tissue)
        unrounded.add(unrounded_db)
        depth_mae_mm = depth.add(frame, picture.depth)
        if record is not None:
            record(
                {
                    "seq": frame.seq,
                    "time_s": frame.time_s,
                    "trained": False,
                    "model_version": picture.model_version,
                    **measures(quality),
                    "psnr_unrounded_db": unrounded_db,
                    "depth_mae_mm": finite(depth_mae_mm),
                }
            )
    return HeldOut(sums.score, unrounded.mean, depth.errors)


class Learner(Protocol):
    """Interface of an online learner such as `Reconstructor`."""

    def observe(self, frame: Frame, *, train: bool = True) -> object:
        """Train on the next frame; with `train=False` only advance to its time."""

    def publish(self) -> Model | Snapshot:
        """Return the current model."""


def published(learner: Learner, frame: Frame) -> Model | Snapshot:
    """Return the learner's current model, which has not been trained on `frame`, to predict it.

    The caller renders it at the frame's time, to which the model extrapolates its motion.
    """
    return learner.publish()


def _hidden(frame: Frame) -> Frame:
    """Return a copy of the frame that contains only number, time and pose, with a black picture.

    Prevents the image from influencing a prediction.
    """
    return Frame(frame.seq, frame.pts_ns, np.zeros_like(frame.image), pose=frame.pose)


def evaluate_causal(
    frames: Iterable[Frame],
    learner: Learner,
    picture_of: Callable[[Model | Snapshot, Frame], Picture],
    *,
    predict: Callable[[Learner, Frame], Model | Snapshot] = published,
    record: Record | None = None,
) -> Score:
    """Predict, score, then train on each frame in order. The first frame has no prediction.

    Damaged and withheld frames are neither scored nor trained on. Frames without tissue are trained on but not scored.

    Args:
        frames: frames in order; leading frames unfit for training are skipped.
        learner: untrained learner.
        picture_of: callback that renders a model for a frame.
        predict: callback that returns the model to render for an unseen frame. The frame passed to it has a black
            image.
        record: callback that receives the figures of each scored frame.

    Returns:
        Mean scores of the predictions.
    """
    sums = ScoreSums()
    started = False
    for frame in frames:
        reason = why_left_out(frame)
        trains = reason in (None, "no tissue")
        if not started:
            sums.leave_out(reason if reason is not None and not trains else "before the first prediction")
            if trains:
                learner.observe(frame)
                started = True
            continue
        if reason is None:
            unseen = _hidden(frame)
            _score(frame, picture_of(predict(learner, unseen), unseen), sums, record)
        else:
            sums.leave_out(reason)
        learner.observe(frame, train=trains)
    return sums.score


def _score(frame: Frame, picture: Picture, sums: ScoreSums, record: Record | None) -> None:
    quality = sums.add(frame, picture.image)
    if record is not None:
        own = {"seq": frame.seq, "time_s": frame.time_s, "trained": False, "model_version": picture.model_version}
        record({**own, **measures(quality)})


NEAR_SHARE = 0.05
"""Distance below which two positions of the scope count as the same place, as a share of the largest distance between any two
positions.
"""
NEAR_DEGREES = 10.0
AWAY = 3.0
"""Smallest distance of the scope from a place between two stays, in multiples of the distance below which positions
count as the same place.

The distance (`_distances`) is the larger of the distances in position and in viewing direction.
"""
MAX_POSES = 2048
"""Maximum number of poses that `PlaceFinder` stores; longer streams are subsampled by powers of two."""
Range = tuple[float, float]
"""First and last time, in seconds."""


@dataclass(frozen=True)
class Visits:
    """Two stays of the scope at the same place, with an absence between them, as ranges of time."""

    first: Range
    again: Range

    def __post_init__(self) -> None:
        if not self.first[0] <= self.first[1] < self.again[0] <= self.again[1]:
            raise InvalidInput(f"visits {self.first} and {self.again} must be two ranges of time, one after the other")


class PlaceFinder:
    """Streaming detector of revisited places with bounded memory; `visits` lists the returns."""

    def __init__(self) -> None:
        self._poses: list[tuple[float, NDArray[np.float64]]] = []
        self._every = 1
        self._seen = 0

    def add(self, time_s: float, world_to_camera: NDArray[np.float64]) -> None:
        """Add the pose [4, 4] of the next frame."""
        if self._seen % self._every == 0:
            self._poses.append((time_s, np.asarray(world_to_camera, np.float64)))
            if len(self._poses) == MAX_POSES:
                self._poses = self._poses[::2]
                self._every *= 2
        self._seen += 1

    def visits(self) -> list[Visits]:
        """Return each revisit of a place, as the previous and the new stay of the scope there."""
        if len(self._poses) < 3:
            return []
        times = [time_s for time_s, _ in self._poses]
        apart = _distances(np.stack([pose for _, pose in self._poses]))
        found: list[Visits] = []
        k = 0
        while k < len(times):
            j = _last_stay(apart[k, :k])
            if j is None:
                k += 1
                continue
            begin = j
            while begin > 0 and apart[k, begin - 1] <= 1:
                begin -= 1
            end = k
            while end + 1 < len(times) and apart[j, end + 1] <= 1:
                end += 1
            found.append(Visits((times[begin], times[j]), (times[k], times[end])))
            k = end + 1
        return found


def _last_stay(apart: NDArray[np.float64]) -> int | None:
    """Return the index of the newest earlier stay at a place, from the distances [K] of earlier poses to it.

    None if the scope has not been away since, or was never there before.
    """
    away = np.flatnonzero(apart >= AWAY)
    if not len(away):
        return None
    near = np.flatnonzero(apart[: away[-1]] <= 1)
    return int(near[-1]) if len(near) else None


def _distances(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pairwise distances [K, K] of poses [K, 4, 4]; 1 is the limit of the same place.

    The distance is the larger of the position and the viewing-direction difference, each divided by its own limit.
    """
    rotations, translations = poses[:, :3, :3], poses[:, :3, 3]
    centres = -np.einsum("kij,ki->kj", rotations, translations)
    between = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    largest = float(between.max())
    axes = rotations[:, 2]  # the third row of a world-to-camera rotation is the viewing direction in the world
    degrees = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    position = between / (NEAR_SHARE * largest) if largest > 0 else np.zeros_like(between)
    return np.maximum(position, degrees / NEAR_DEGREES)


LAST_S = 5.0
FOUND_DB = 33.0
"""Tissue PSNR in dB from which a revisited place counts as recovered."""
FIRST_FRAMES = 3


@dataclass(frozen=True)
class PlaceScore:
    """Scores of the final model at a place visited twice, for each stay."""

    visits: Visits
    first: Score
    again: Score


@dataclass(frozen=True)
class Retention:
    """Scores of the final model on frames from earlier in the stream."""

    last: Score
    """Score of the final model on the frames of the last seconds of the stream."""
    last_range_s: Range
    frozen: BaselineScore
    """Baseline: the last usable frame of `last_range_s` as a still, scored on the other frames of that range."""
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
    """Render earlier frames with the final model and score them; iterates over the frames twice.

    Args:
        frames: frames of the recording, in order on each iteration.
        picture_of: callback that renders the final model for a frame.
        window_s: first and last time in seconds that the model was trained on.
        last_s: length of the scored end of the window in seconds.
        places: revisited places found by `PlaceFinder`.
        record: callback that receives the figures of each scored frame of the last seconds.

    Returns:
        Scores of the last seconds and of the revisited places.

    Raises:
        InvalidInput: if `frames` is an iterator, which can be read only once.
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
    """Return the revisited places of a recording by its poses; empty without poses."""
    finder = PlaceFinder()
    for frame in frames:
        if frame.pose is not None:
            finder.add(frame.time_s, frame.pose)
    return finder.visits()


@dataclass(frozen=True)
class Return:
    """Recovery of image quality after the return to a place, taken from the figures of a live or causal run."""

    visits: Visits
    first_db: tuple[float | None, ...]
    """Tissue PSNR in dB of the first frames of the second stay; None for a frame without a score."""
    frames_until_found: int | None
    """1-based index of the first frame that scored `FOUND_DB` or more; None if none did."""


def returns(entries: Iterable[Entry], places: Sequence[Visits]) -> list[Return]:
    """Extract the scores of the first frames of each return from a live or causal log."""
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
    # Tolerate the rounding of times that were converted from nanoseconds.
    return times[0] - 1e-6 <= frame.time_s <= times[1] + 1e-6


def _frozen(frames: Iterable[Frame], shown: Frame | None, tail: Range) -> BaselineScore:
    """Return the score of the picture of the frame `shown`, as a still, on all other frames in the time range `tail`."""
    tissue, whole = ScoredMean(), ScoredMean()
    for frame in frames if shown is not None else ():
        assert shown is not None
        if _within(frame, tail) and frame.seq != shown.seq and why_left_out(frame) is None:
            tissue_db, frame_db = psnrs_db(shown.image, frame.image, frame.tissue)
            tissue.add(tissue_db)
            whole.add(frame_db)
    return BaselineScore(tissue.mean, whole.mean, tissue.count)
