"""Choice of the number of offline training steps by frames that are kept from training.

The training frames themselves are split. The held-out frames of the evaluation are never read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import NamedTuple

from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.offline import ToFit
from gsplat_core.training.reconstructor import Reconstructor

VALIDATE_EVERY = 9
"""Interval of validation frames among the training frames."""
LEAST_FRAMES = 1
"""Smallest number of validation frames from which steps are chosen."""
FIRST_STEPS = 500
"""Training steps of the first trial. Each further trial has twice as many."""
MOST_STEPS = 64_000
"""Largest number of training steps that is tried."""
LEAST_GAIN_DB = 0.05
"""Smallest gain of a trial, in dB, for which longer trainings are tried."""
INPUT_GAIN_DB = 0.3
"""Smallest gain, in dB, for which other inputs than the given ones are used. Depth is not left out for less, because it
also gives the scale and the shape.
"""
USUAL_STEPS = 2000
"""Number of training steps for recordings with too few frames to validate."""

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

    def duration_s(self, steps: int) -> float:
        """Return the expected duration in seconds of a training with another number of steps."""
        return self.setup_s + steps * self.seconds / self.steps


@dataclass(frozen=True)
class ChosenSteps:
    """Number of steps for the training on all frames, with the trials that led to it."""

    steps: int
    trials: tuple[Trial, ...]
    reason: str
    """`given`, `best`, `limit` (the time limit ended the search), `most` (largest number tried) or `few frames`."""
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
            return f"{self.steps} training steps, the usual number: too few frames to keep some for validation"
        found = f" (validation frames: {tried})" if tried else ""
        kept = ". There was no time left to train on the validation frames too" if self.keeps_trial else ""
        return f"{self.steps} training steps were chosen{found}: {reasons[self.reason]}{kept}"


def validating(count: int) -> list[int]:
    """Return the indices of the frames that validate among `count` training frames; never the first or last one."""
    return list(range(VALIDATE_EVERY // 2, count - 1, VALIDATE_EVERY))


def split(given: ToFit) -> tuple[ToFit, list[Frame]]:
    """Return the frames to train on, and the validation frames."""
    apart = set(validating(len(given.frames)))
    kept = [number for number in range(len(given.frames)) if number not in apart]
    chosen = lambda items: [items[number] for number in kept]
    return replace(given, frames=chosen(given.frames), seen=chosen(given.seen)), [
        given.frames[n] for n in sorted(apart)
    ]


def validation_psnr_db(learned: Reconstructor, frames: Sequence[Frame]) -> float:
    """Return the mean tissue PSNR of a reconstruction on validation frames, in dB; 0 if none has tissue."""
    scores = [psnr_tissue_db(learned.picture(frame), frame.image, frame.mask) for frame in frames]
    # A frame without tissue has no score.
    return fmean([each for each in scores if math.isfinite(each)] or [0.0])


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
        # A trial is followed by a training of the same length on all frames.
        if 2 * best.duration_s(steps) > left_s:
            longest = int((left_s - best.setup_s) * best.steps / best.seconds) if best.seconds else 0
            if longest < best.steps:
                return ChosenSteps(best.steps, tuple(trials), "limit", keeps_trial=True)
            return ChosenSteps(min(steps, longest), tuple(trials), "limit")
        trial = trial_of(train, steps, clock)
        trials.append(trial)
        if trial.psnr_db < best.psnr_db + LEAST_GAIN_DB:
            return ChosenSteps(max(trial, best, key=lambda one: one.psnr_db).steps, tuple(trials), "best")
        best = trial
    return ChosenSteps(best.steps, tuple(trials), "most")
