"""Training on all frames of a recording: trajectories before training, frame order, decay of learning rates, smoothing of
motion in time and space, correction of colours at the end, and choice of the number of steps.

Smoothing and correction depend on how evenly the pictures change (`steadiness`).

Trajectories of Gaussians over the recording are estimated before training. Optical flow tracks each surface point from
frame to frame. Frames with depth give the distance at its position, because one eye's pictures hardly show motion along
the line of sight, and the loss alone would leave each Gaussian near its initial distance. Without depth the points move
across the picture only. Training from static Gaussians would explain large motion by changing colours, which are wrong
between the frames.

`choose_steps` chooses the number of steps by frames that are kept from training. The training frames themselves are
split. The held-out frames of the evaluation are never read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.choices import STRATEGIES
from gsplat_core.depth.maps import OfRecording, new_estimator, possible_depth, with_surface
from gsplat_core.depth.plane_fits import filled_depth
from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.registration import nearest_others
from gsplat_core.machine import usable_cores
from gsplat_core.ops.surface_motion import surface_path
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.image_motion import SMALLEST_PX, Flow, ImageMotion, Seen, SurfaceMotion, beside
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.training.strategies.strategy import Plan
from gsplat_core.transfers import tensor_of

EDGE_PX = 1
"""Width in pixels of the margin around tools and depth holes where depth is not read, since tracked points may be off."""
POSITIONS_AT_ONCE = 1 << 22
"""Largest number of trajectory positions (Gaussians times frames) that are computed at once, to limit memory."""
FEWEST_ROWS = 64
"""Smallest number of Gaussians whose trajectories are computed at once, also for very long recordings."""


class SurfaceTracks:
    """Trajectories of surface points through the frames of a recording, if pictures show the motion."""

    def __init__(
        self,
        frames: Sequence[Frame],
        observations: Sequence[Observation],
        at_rest: bool = False,
    ) -> None:
        """Prepare the trajectories.

        Args:
            frames: all frames.
            observations: the same frames as tensors.
            at_rest: True if depth was estimated for static tissue (`RecordingDepth.at_rest`).
        """
        self._at_rest = at_rest
        self._frames, self._seen = frames, observations
        self._device = observations[0].image.device
        self._times = observations[0].image.new_tensor([one.time_s for one in observations], dtype=torch.float32)

    def apply(self, step: TrainingStep, number: int, first_row: int) -> None:
        """Set the trajectories of the Gaussians from `first_row` on, which are on the surface shown by frame `number`.
        Nothing changes if the field does not support it or the pictures have no optical flow.
        """
        follow = step.capabilities.follow
        if follow is None or not self._show_motion:
            return
        times = [one.time_s for one in self._seen]
        with torch.no_grad():
            at_once = max(FEWEST_ROWS, POSITIONS_AT_ONCE // len(times))
            for start in range(first_row, step.gaussians.count, at_once):
                rows = slice(start, min(start + at_once, step.gaussians.count))
                points = step.gaussians.means[rows]
                follow(rows, times, self.trajectories(points, number) - points[:, None])

    def trajectories(self, points: Tensor, number: int) -> Tensor:
        """Return the positions in every frame [N, T, 3] of points [N, 3] on the surface shown by frame `number`. Without
        depth, or with depth estimated for static tissue, points only move across the picture.
        """
        if self._at_rest or not self._have_depth:
            return self._across(points, number)
        pixels = self._pixels(points, number)
        nothing = points.new_zeros(len(points))
        read = [
            (nothing, nothing) if depth is None else depth.at(here)
            for depth, here in zip(self._depths, pixels, strict=True)
        ]
        smooth, relief = (torch.stack(each, dim=1) for each in zip(*read, strict=True))
        # Interpolate the ratio to the surrounding surface while a tool hides a point.
        depth = smooth * between_known(relief, torch.ones_like(relief), self._times)
        depth = 1 / steady_course(1 / between_known(depth, depth, self._times), self._times)
        return torch.stack([_world(pixels[k], depth[:, k], one) for k, one in enumerate(self._seen)], dim=1)

    def _across(self, points: Tensor, number: int) -> Tensor:
        """Return the trajectories of points seen in frame `number`, with motion across the picture only. Depth differences
        of static tissue are errors and would move points in front of other points.
        """
        cameras = [one.camera for one in self._seen]
        after = _path(points, self._flows_ahead[number:], cameras[number:])
        before = _path(points, self._flows_back[:number].flip(0), cameras[number::-1])
        return torch.cat([before.flip(1), points[:, None], after], dim=1)

    @cached_property
    def _show_motion(self) -> bool:
        """True if the camera is a pinhole, and pictures are large enough for flow."""
        sizes = {frame.image.shape[:2] for frame in self._frames}
        pinhole = all(one.camera.model == "pinhole" for one in self._seen)
        return pinhole and len(self._frames) > 1 and len(sizes) == 1 and min(min(sizes)) >= SMALLEST_PX

    @cached_property
    def _have_depth(self) -> bool:
        """True if at least half of the frames have depth that the depth loss compares."""
        return 2 * sum(depth is not None for depth in self._depths) >= len(self._frames)

    @cached_property
    def _depths(self) -> list[SurfaceDepth | None]:
        """Depth of each frame; None if it is not confident or its scale varies, so that the loss ignores it."""
        return [
            None if one.depth is None or not one.depth.any() else SurfaceDepth.of(possible_depth(frame), self._device)
            for frame, one in zip(self._frames, self._seen, strict=True)
        ]

    @cached_property
    def _flows_ahead(self) -> Tensor:
        """Flow from each frame to the next one, [T - 1, h, w, 2]."""
        return self._stacked(_flows(list(pairwise(self._frames))))

    @cached_property
    def _flows_back(self) -> Tensor:
        """Flow from each frame except the first to the previous frame, [T - 1, h, w, 2]."""
        return self._stacked(_flows([(after, before) for before, after in pairwise(self._frames)]))

    def _stacked(self, flows: Sequence[Flow]) -> Tensor:
        return tensor_of(np.stack(flows), self._device)

    def _pixels(self, points: Tensor, number: int) -> list[Tensor]:
        """Return the points' positions in each frame: T times [N, 2]."""
        here = Seen(self._seen[number].camera, points).pixels
        after, before = [here], [here]
        cameras = [one.camera for one in self._seen]
        for flow, camera in zip(self._flows_ahead[number:], cameras[number:], strict=False):
            after.append(after[-1] + SurfaceMotion(flow, camera, camera).at(after[-1]))
        for flow, camera in zip(self._flows_back[:number].flip(0), cameras[number:0:-1], strict=True):
            before.append(before[-1] + SurfaceMotion(flow, camera, camera).at(before[-1]))
        return before[:0:-1] + after


@dataclass(frozen=True)
class SurfaceDepth:
    """Depth map of one frame as planes that can be sampled at tracked points, also where a tool hides the depth."""

    planes: Tensor
    """Planes [3, H, W]: depth away from edges, 0 elsewhere; validity of it; surface extrapolated everywhere."""

    @staticmethod
    def of(depth: NDArray[np.float32], device: torch.device) -> SurfaceDepth | None:
        """Prepare tissue depth [H, W], 0 where unknown. Returns None if it is unknown everywhere."""
        known = np.isfinite(depth) & (depth > 0)
        if not known.any():
            return None
        side = 2 * EDGE_PX + 1
        inner = cv2.erode(known.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        planes = np.stack([np.where(inner, depth, 0), inner, filled_depth(depth, known)]).astype(np.float32)
        return SurfaceDepth(tensor_of(planes, device))

    def at(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Sample at pixels [N, 2] bilinearly. Returns the smooth depth [N], and the ratio of the
        depth to it [N], 0 where unknown.
        """
        size = beside(pixels, [self.planes.shape[2], self.planes.shape[1]])
        grid = (2 * pixels / size - 1)[None, None]
        found, known, smooth = torch.nn.functional.grid_sample(
            self.planes[None], grid, padding_mode="border", align_corners=False
        )[0, :, 0]
        return smooth, torch.where(known > 1 - 1e-3, found / smooth, 0.0)


def between_known(values: Tensor, otherwise: Tensor, times: Tensor) -> Tensor:
    """Interpolate unknown values linearly in time.

    Args:
        values: [N, T], 0 where unknown. Values before the first and after the last known one are constant.
        otherwise: [N, T], used for rows without any known value.
        times: [T].
    """
    known = values > 0
    index = torch.arange(values.shape[1], device=values.device).expand_as(values)
    last = torch.where(known, index, -1).cummax(dim=1).values
    following = torch.where(known, index, values.shape[1]).flip(1).cummin(dim=1).values.flip(1)
    has_last, has_next = last >= 0, following < values.shape[1]
    last, following = last.clamp(min=0), following.clamp(max=values.shape[1] - 1)
    last, following = torch.where(has_last, last, following), torch.where(has_next, following, last)
    a, b = values.gather(1, last), values.gather(1, following)
    span = times[following] - times[last]
    share = torch.where(span > 0, (times - times[last]) / span.clamp(min=1e-9), torch.zeros_like(span))
    return torch.where(known.any(dim=1, keepdim=True), a + share * (b - a), otherwise)


def steady_course(values: Tensor, times: Tensor) -> Tensor:
    """Shrink each row of `values` [N, T] towards its median by the share of its variation over
    `times` [T] that noise explains.

    Noise is estimated from deviations of values from the line between their temporal neighbours, as
    in `steadiness`; the share is that of a Wiener filter. With fewer than three values the result
    is the median. Results stay within the range of their row.
    """
    middle = values.median(dim=1, keepdim=True).values
    if values.shape[1] < 3:
        return middle.expand_as(values)
    span = times[2:] - times[:-2]
    share = torch.where(span > 0, (times[1:-1] - times[:-2]) / span.clamp(min=1e-9), 0.5)
    off = values[:, 1:-1] - torch.lerp(values[:, :-2], values[:, 2:], share)
    # The variances of a value and of the interpolation between its two temporal neighbours add up.
    noise = (off.square() / (1 + share.square() + (1 - share).square())).mean(dim=1, keepdim=True)
    found = (values - middle).square().mean(dim=1, keepdim=True)
    return middle + (1 - noise / found.clamp(min=torch.finfo(found.dtype).tiny)).clamp(0, 1) * (values - middle)


def _path(points: Tensor, flows: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Return the positions [N, T, 3] of points [N, 3] after each of the flows [T, h, w, 2] between the cameras' frames."""
    if points.dtype == torch.float32:
        return surface_path(points, flows, cameras)
    positions = [points]
    for flow, (before, after) in zip(flows, pairwise(cameras), strict=True):
        positions.append(positions[-1] + SurfaceMotion(flow.to(points), before, after).ahead(positions[-1]))
    return torch.stack(positions[1:], dim=1) if len(positions) > 1 else points.new_empty(len(points), 0, 3)


def _flows(pairs: Sequence[tuple[Frame, Frame]]) -> list[Flow]:
    """Return the flow from the first to the second frame of each pair."""
    with ThreadPoolExecutor(usable_cores(), thread_name_prefix="flow") as pool:
        return list(pool.map(_flow, pairs))


def _flow(pair: tuple[Frame, Frame]) -> Flow:
    motion = ImageMotion()
    for frame in pair:
        flow = motion.follow(frame.image, frame.tissue)
    assert flow is not None  # pictures of one size, large enough
    return flow


def _world(pixels: Tensor, depth: Tensor, one: Observation) -> Tensor:
    """Return the points [N, 3] that a frame's camera sees at pixels [N, 2] and depth [N]."""
    view, intrinsics = one.camera.matrices(pixels.device, pixels.dtype)
    slopes = (pixels - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
    local = torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1) * depth[:, None]
    return (local - view[:3, 3]) @ view[:3, :3]


NOISE_LEVELS = 2.5
"""Standard deviation of noise in compressed video, in grey levels of 255."""
MOST_FRAMES = 32
"""Largest number of frames that `steadiness` examines, spread over the recording."""


def steadiness(observations: Sequence[Observation]) -> float:
    """Return the ratio of the noise variance to the mean squared deviation of frames from the interpolation of their
    neighbours, 0 to 1.

    The value is 1 if the deviation is at most noise. Temporal smoothing removes this
    deviation, so the ratio is the admissible amount of smoothing. Only tissue counts; without three frames with tissue
    it is 1. Integer sums make the result independent of the order. Synchronises once.
    """
    inner = range(1, len(observations) - 1)
    squared = torch.zeros(2, dtype=torch.int64, device=observations[0].image.device)
    for number in inner[:: max(1, -(-len(inner) // MOST_FRAMES))]:
        before, now, after = observations[number - 1 : number + 2]
        span_s = after.time_s - before.time_s
        share = (now.time_s - before.time_s) / span_s if span_s > 0 else 0.5
        between = torch.lerp(before.image.float(), after.image.float(), share).round()
        tissue = (before.mask != 0) & (now.mask != 0) & (after.mask != 0)
        off = (now.image.float() - between).to(torch.int64).square().sum(-1) * tissue
        squared += torch.stack([off.sum(), 3 * tissue.sum()])
    total, values = squared.tolist()
    # Noise variance of a frame plus that of the mean of two other frames.
    noise = 1.5 * NOISE_LEVELS**2
    return min(1.0, noise * values / total) if total else 1.0


SMOOTH_EVERY = 20
"""Number of training steps between two smoothings, which process the motion at all times, unlike a training step."""
MOST_AT_ONCE = 0.5
"""Largest share of the way to the neighbours' mean in one smoothing."""


FINAL_RATE = 0.02
"""Ratio of the final to the initial learning rates, which decay by a half-cosine."""
SMOOTHING = 1.5
"""Strength of temporal smoothing: share of the way to the mean of the temporal neighbours per pass over all frames, scaled by
the learning rates' factor. It suppresses noise of single frames and is reduced for fast motion (`steadiness`).
"""
RIGIDITY = 1.0
"""Strength of spatial smoothing: share of the way of a Gaussian's motion to its neighbours' mean per pass over all frames,
scaled by the learning rates' factor. It is reduced for fast motion by the root of `steadiness`.
"""

CORRECTION = 1.0
"""Relaxation of the colour corrections at the end of training. Recordings with a `steadiness` below 1 get no corrections.

A correction at the time of one frame also changes the colours of its neighbours in time.
"""
CORRECT_FROM = 0.5
"""Share of the steps after which colours are corrected instead of trained, with a relaxation that grows from 0."""


def correction_at(share: float) -> float:
    """Return the factor of the relaxation of colour corrections after this share of the steps."""
    return max(0.0, (share - CORRECT_FROM) / (1 - CORRECT_FROM))


def rate_at(share: float) -> float:
    """Return the factor of the learning rates after this share of the steps."""
    return FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * share))


SPACING_INTERVALS = 1.5
"""Finest useful temporal resolution of motion, in multiples of the median interval between frames (`least_spacing_s`)."""


def least_spacing_s(times_s: Sequence[float]) -> float:
    """Return the smallest useful temporal resolution of motion in seconds, for frames at `times_s`; 0 for one frame.

    A finer field has parameters that no frame trains. Between frames they would let the scene return to its rest state.
    """
    intervals = [after - before for before, after in pairwise(times_s) if after > before]
    return SPACING_INTERVALS * median(intervals) if intervals else 0.0


def observed(frames: Sequence[Frame], observation_of: Callable[[Frame], Observation]) -> list[Observation]:
    """Convert frames to observations.

    Raises:
        InvalidInput: if there are no frames, or if they are out of temporal order.
    """
    if not frames:
        raise InvalidInput("there are no frames to train on")
    for before, frame in pairwise(frames):
        if frame.time_s < before.time_s:
            raise InvalidInput(
                f"frame {frame.seq} is at {frame.time_s:.3f} s, before the last one at {before.time_s:.3f} s;"
                " frames must come in order"
            )
    return [observation_of(frame) for frame in frames]


@dataclass(frozen=True)
class ToFit:
    """Frames and observations prepared for offline training. Several trainings can share it."""

    frames: list[Frame]
    """Frames from which the scene is created and grown."""
    seen: list[Observation]
    """Observations to train on."""
    doubts: Mapping[str, int]
    """Reasons for frames without depth, with numbers of frames (`RecordingDepth.doubts`)."""
    at_rest: bool = False

    @cached_property
    def tracks(self) -> SurfaceTracks:
        """Trajectories of the surface through the frames."""
        return SurfaceTracks(self.frames, self.seen, self.at_rest)


def to_fit(frames: list[Frame], observation_of: Callable[[Frame], Observation], depth: str | None) -> ToFit:
    """Prepare frames for offline training; `frames` is modified.

    Without depth a scene starts on a plane. A plane at the wrong distance turns camera motion into
    apparent tissue motion, which must be learned separately for every time and does not interpolate.

    Args:
        frames: frames in temporal order. Depth of an origin with a `surface` function is smoothed.
        observation_of: converts a frame.
        depth: name of an estimator of depth from all frames, see `of_recording`; None for none.

    Raises:
        InvalidInput: if there are no frames, or if they are out of temporal order.
    """
    seen = observed(frames, observation_of)
    cameras = [each.camera for each in seen]
    with ThreadPoolExecutor(usable_cores(), thread_name_prefix="surface") as pool:
        surfaces = list(pool.map(with_surface, frames, cameras))
    for number, (frame, surface) in enumerate(zip(frames, surfaces, strict=True)):
        if surface is not frame:
            frames[number], seen[number] = surface, observation_of(surface)
    estimator = None if depth is None else new_estimator(depth)
    if not isinstance(estimator, OfRecording):
        return ToFit(frames, seen, {})
    found = estimator.of_recording(frames, cameras)
    # Unconfident depth is an extrapolation: it initialises the scene but is not trained on.
    start = [
        frame if frame is given else frame.with_fields(depth_confidence=None)
        for given, frame in zip(frames, found.frames, strict=True)
    ]
    return ToFit(start, observed(found.frames, observation_of), found.doubts, found.at_rest)


class OfflineTraining:
    """Training loop of one `fit`."""

    def __init__(
        self,
        step: TrainingStep,
        observations: Sequence[Observation],
        *,
        most_gaussians: int,
        seed: int,
        strategy: str = "streaming",
    ) -> None:
        self._step = step
        self._kind = STRATEGIES[strategy]
        rights = [one.right for one in observations if one.right is not None]
        self._observations = [*observations, *rights]
        """Observations of both eyes."""
        self._most_gaussians, self._seed = most_gaussians, seed
        steady = steadiness(observations)
        # `steadiness` is a ratio of squares; differences between neighbouring motions scale with its root.
        self._smoothing, self._rigidity = SMOOTHING * steady, RIGIDITY * math.sqrt(steady)
        self._correction = CORRECTION if steady == 1 and step.has_colours_in_time else 0.0
        self._random = np.random.default_rng(seed)
        self._order: list[int] = []
        self._rate = 1.0
        self._neighbours: Tensor | None = None
        """Neighbours of each Gaussian, int64 [N, K]; None if they must be searched again."""

    def __call__(self, steps: int, progress: Callable[[int, Tensor], None] | None) -> Tensor:
        """Run `steps` steps, calling `progress` after each. Returns the last loss, [] on the device."""
        strategy = self._kind.training(
            Plan(self._step, self._observations, steps, self._most_gaussians, self._random, self._seed)
        )
        loss = torch.zeros(())
        for number in range(steps):
            if strategy.before_step(number, self._rate):
                self._neighbours = None
            share = number / steps
            self._rate = rate_at(share)
            observation = self._next()
            loss = self._step(observation, self._rate, self._relaxation(number, share, observation))
            if (number + 1) % SMOOTH_EVERY == 0:
                self._smooth()
            if progress is not None:
                progress(number + 1, loss)
        self._step.settle(self._observations[-1], rate_scale=self._rate)
        return loss

    def _relaxation(self, number: int, share: float, observation: Observation) -> float:
        """Return the relaxation of a step; 0 for a step that trains colours instead of correcting them.

        A correction by the right eye would change all times. A captured step that corrects colours compares no depth,
        so every second step of frames with depth trains.
        """
        if observation.of_right or (observation.depth is not None and number % 2):
            return 0.0
        return self._correction * correction_at(share)

    def _next(self) -> Observation:
        """Return the next observation: all in a random order, then all in another order, and so on."""
        if not self._order:
            self._order = self._random.permutation(len(self._observations)).tolist()
        return self._observations[self._order.pop()]

    def _smooth(self) -> None:
        """Smooth the motion in time and among neighbours, as much as is due for `SMOOTH_EVERY` steps."""
        each = self._rate * SMOOTH_EVERY / len(self._observations)
        smooth_in_time, share_motion = self._step.capabilities.smooth_in_time, self._step.capabilities.share_motion
        if self._smoothing and smooth_in_time is not None:
            smooth_in_time(min(self._smoothing * each, MOST_AT_ONCE))
        if self._rigidity and share_motion is not None:
            if self._neighbours is None:
                self._neighbours = nearest_others(self._step.gaussians.means)
            share_motion(self._neighbours, min(self._rigidity * each, MOST_AT_ONCE))


VALIDATE_EVERY = 9
"""Every n-th training frame is kept from training as a validation frame."""
LEAST_FRAMES = 1
"""Smallest number of validation frames with which the number of training steps is chosen by trials."""
FIRST_STEPS = 500
"""Training steps of the first trial in the search for the best number of steps. Each further trial has twice as many."""
MOST_STEPS = 64_000
"""Largest number of training steps that `choose_steps` tries."""
LEAST_GAIN_DB = 0.05
"""Smallest gain in validation PSNR from doubling the training steps, in dB, after which a doubling is tried again."""
INPUT_GAIN_DB = 0.3
"""Smallest gain in validation PSNR, in dB, for which depth or the right eye is left out, or estimated camera poses are used.
Depth is not left out for less, because it also gives the scale and the shape.
"""
USUAL_STEPS = 2000
"""Number of training steps for recordings that have too few frames for validation frames."""

Clock = Callable[[], float]
"""Function that returns the time in seconds, for measuring durations."""


class Trained(NamedTuple):
    """Result of one training without the validation frames."""

    psnr_db: float
    """Mean tissue PSNR of the validation frames, in dB."""
    setup_s: float = 0.0
    """Time before the first step, in seconds."""


Train = Callable[[int], Trained]
"""Function that trains from the start with a number of steps."""


@dataclass(frozen=True)
class Trial:
    """Training with some number of steps, and its score on the validation frames."""

    steps: int
    psnr_db: float
    """Mean tissue PSNR of the validation frames, in dB."""
    setup_s: float = 0.0
    """Time before the first step, in seconds."""
    seconds: float = 0.0
    """Duration of the training and its validation, without the time before the first step."""

    @property
    def duration_s(self) -> float:
        """Duration in seconds of the training and its validation."""
        return self.setup_s + self.seconds


@dataclass(frozen=True)
class ChosenSteps:
    """Number of steps for the training on all frames, with the trials that led to it."""

    steps: int
    trials: tuple[Trial, ...]
    reason: str
    """`given`, `best`, `limit` (the time limit ended the search), `most` (largest number tried), `few frames` or `interrupted`
    (by a stop request)."""
    keeps_trial: bool = False
    """True if the time limit leaves no time to train on all frames, so that the best trial is the result."""

    @property
    def sentence(self) -> str:
        """Return the choice and its reason as a sentence for reports."""
        tried = ", ".join(f"{one.steps} steps {one.psnr_db:.2f} dB" for one in self.trials)
        reasons = {
            "best": "longer training does not improve them",
            "limit": "the time limit ended the search, so another machine may choose otherwise; --minutes raises it",
            "most": f"{MOST_STEPS} steps are the most that are tried",
        }
        if self.reason == "few frames":
            usual = (
                "the usual number"
                if self.steps >= USUAL_STEPS
                else f"fewer than the usual {USUAL_STEPS}, because the time limit leaves no time for more; --minutes raises it"
            )
            return f"{self.steps} training steps, {usual}: too few frames to keep some for validation"
        found = f" (validation frames: {tried})" if tried else ""
        kept = ". There was no time left to train on the validation frames too" if self.keeps_trial else ""
        return f"{self.steps} training steps were chosen{found}: {reasons[self.reason]}{kept}"


def validating(count: int) -> list[int]:
    """Return the indices of the validation frames among `count` training frames; never the first or last one."""
    return list(range(VALIDATE_EVERY // 2, count - 1, VALIDATE_EVERY))


def split(given: ToFit) -> tuple[ToFit, list[Frame]]:
    """Return the frames to train on, and the validation frames."""
    apart = set(validating(len(given.frames)))
    kept = [number for number in range(len(given.frames)) if number not in apart]
    chosen = lambda items: [items[number] for number in kept]
    return replace(given, frames=chosen(given.frames), seen=chosen(given.seen)), [
        given.frames[n] for n in sorted(apart)
    ]


def trial_of(train: Train, steps: int, clock: Clock) -> Trial:
    """Train with a number of steps and return the score and the duration."""
    began = clock()
    trained = train(steps)
    return Trial(steps, trained.psnr_db, trained.setup_s, max(0.0, clock() - began - trained.setup_s))


def choose_steps(
    train: Train, limit_s: float, clock: Clock, spent_s: float = 0.0, first: Trial | None = None
) -> ChosenSteps:
    """Find the number of steps with the best validation score, by trials of doubling length.

    The search leaves enough of the time limit for the training on all frames. The first trial is made in any case; if it
    takes too long for a second training, it is the result.

    Args:
        train: trains without the validation frames.
        limit_s: time for the search and the training on all frames, in seconds.
        clock: source of the time.
        spent_s: part of the limit that is already spent, in seconds.
        first: trial of `FIRST_STEPS`, if it is known.
    """
    begin = clock() - spent_s
    best = first or trial_of(train, FIRST_STEPS, clock)
    trials = [best]
    while 2 * best.steps <= MOST_STEPS:
        steps = 2 * best.steps
        left_s = limit_s - (clock() - begin)
        per_step_s = _per_step_s(trials)
        expected_s = best.duration_s + (steps - best.steps) * per_step_s
        # A trial is followed by a training of the same length on all frames.
        if 2 * expected_s > left_s:
            if best.duration_s > left_s:
                return ChosenSteps(best.steps, tuple(trials), "limit", keeps_trial=True)
            if expected_s > left_s:
                steps = best.steps + math.floor((left_s - best.duration_s) / per_step_s)
            return ChosenSteps(steps, tuple(trials), "limit")
        trial = trial_of(train, steps, clock)
        trials.append(trial)
        if trial.psnr_db < best.psnr_db + LEAST_GAIN_DB:
            return ChosenSteps(max(trial, best, key=lambda one: one.psnr_db).steps, tuple(trials), "best")
        best = trial
    return ChosenSteps(best.steps, tuple(trials), "most")


def _per_step_s(trials: Sequence[Trial]) -> float:
    """Return the expected time in seconds of a further step, by the last two trials. Trainings also take time that does not grow with
    the number of steps, as when Gaussians are added. If the first of the two was slowed down, it is the mean time of the last one."""
    last = trials[-1]
    mean_s = last.seconds / last.steps
    if len(trials) == 1:
        return mean_s
    before = trials[-2]
    grown_s = (last.seconds - before.seconds) / (last.steps - before.steps)
    return grown_s if 0 < grown_s < mean_s else mean_s
