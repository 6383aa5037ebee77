"""Training on all frames of a recording: frame order, decay of learning rates, smoothing of motion in time and space,
and correction of colours at the end.

Smoothing and correction depend on how evenly the pictures change (`steadiness`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from statistics import median

import numpy as np
import torch
from torch import Tensor

from gsplat_core.choices import STRATEGIES
from gsplat_core.depth.maps import OfRecording
from gsplat_core.depth.registry import new_estimator, with_surface
from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.registration import nearest_others
from gsplat_core.scene.frames import Frame
from gsplat_core.training.motion.surface_tracks import SurfaceTracks
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.training.strategies.strategy import Plan

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
"""Relaxation of the colour corrections at the end of training, if `steadiness` is 1; other frames are not corrected.

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
"""Smallest temporal resolution of motion, in intervals between frames."""


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
    for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True)):
        surface = with_surface(frame, camera)
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
