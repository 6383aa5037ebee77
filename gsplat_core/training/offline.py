"""Training on all frames of a recording at once: where the scene starts, the frames' order, the learning rates' decay, smoothing, and when
Gaussians are split."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.frames import Frame
from gsplat_core.training.densification import UNSEEN_PX, densify, on_tissue, shares_of
from gsplat_core.training.nearest import nearest_others
from gsplat_core.training.observations import Observation
from gsplat_core.training.steadiness import steadiness
from gsplat_core.training.step import TrainingStep

SMOOTH_EVERY = 20
"""Steps from one smoothing to the next: it touches all columns, a step only those near its time."""
MOST_AT_ONCE = 0.5
"""Of the way to the neighbours' mean."""


@dataclass(frozen=True)
class FitSettings:
    """How `Reconstructor.fit` goes through its steps. Raises InvalidSetting for a value out of its range."""

    final_rate: float = 0.02
    """What is left of every learning rate at the end, as a share; on the way there they follow half a cosine."""
    smoothing: float = 1.5
    """How far, in a pass over all frames, what the field learned for each time is moved to the mean of its neighbours in time, times the
    factor of the learning rates: a frame between two others is then shown between them, not with the noise of both. Where frames are not
    between their neighbours, because things move fast, it is less (`steadiness`). 0: not at all."""
    rigidity: float = 1.0
    """How far, in a pass over all frames, the motion of each Gaussian is moved to the mean of its neighbours', times the factor of the learning rates: tissue moves
    as one piece, and what moves by itself is most often noise. Less where things move fast, by the root of `steadiness`. 0: not at all."""
    densify_rounds: int = 6
    """How often Gaussians that nobody sees are dropped and those with the largest error are split; 0: never."""
    densify_until: float = 0.7
    """Share of the steps after which the last of these rounds is; the rounds are spread evenly."""
    densify_frames: int = 12
    """Frames, chosen at random for each round, in which the error is looked for."""

    def __post_init__(self) -> None:
        for name in ("final_rate", "densify_until"):
            if not 0 < getattr(self, name) <= 1:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be above 0 and at most 1")
        for name in ("smoothing", "rigidity"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InvalidSetting(f"{name} is {getattr(self, name)}; it must be at least 0")
        if self.densify_rounds < 0 or self.densify_frames < 1:
            raise InvalidSetting(
                f"densify_rounds is {self.densify_rounds} and densify_frames {self.densify_frames}; they must be at least 0 and 1"
            )

    def rate_at(self, share: float) -> float:
        """The factor of the learning rates after this share of the steps."""
        return self.final_rate + (1 - self.final_rate) * 0.5 * (1 + math.cos(math.pi * share))

    def rounds(self, steps: int) -> list[int]:
        """After how many of the steps each round of densification is."""
        return [round(steps * self.densify_until * (k + 1) / self.densify_rounds) for k in range(self.densify_rounds)]


def observed(frames: Sequence[Frame], observation_of: Callable[[Frame], Observation]) -> list[Observation]:
    """The frames in the types of training, in order. Raises InvalidInput when there are none, or when they are not in order."""
    if not frames:
        raise InvalidInput("there are no frames to train on")
    for before, frame in pairwise(frames):
        if frame.time_s < before.time_s:
            raise InvalidInput(
                f"frame {frame.seq} is at {frame.time_s:.3f} s, before the last one at {before.time_s:.3f} s;"
                " frames must come in order"
            )
    return [observation_of(frame) for frame in frames]


class OfflineTraining:
    """The steps of one `fit`."""

    def __init__(
        self,
        step: TrainingStep,
        observations: Sequence[Observation],
        settings: FitSettings,
        *,
        most_gaussians: int,
        seed: int,
    ) -> None:
        self._step, self._settings = step, settings
        rights = [one.right for one in observations if one.right is not None]
        self._observations = [*observations, *rights]
        """Of both eyes."""
        self._first_count, self._most = step.gaussians.count, most_gaussians
        steady = steadiness(observations) if settings.smoothing or settings.rigidity else 0.0
        # A ratio of squares; what neighbours' motions differ by goes with its root.
        self._smoothing, self._rigidity = settings.smoothing * steady, settings.rigidity * math.sqrt(steady)
        self._random = np.random.default_rng(seed)
        self._order: list[int] = []
        self._rate = 1.0
        self._neighbours: Tensor | None = None
        """Of each Gaussian; None: to be looked for, as they are others now."""

    def __call__(self, steps: int, progress: Callable[[int, Tensor], None] | None) -> Tensor:
        """Take `steps` steps; `progress` is called after each one. Returns the last one's loss, a tensor [] on the device."""
        rounds = self._settings.rounds(steps)
        loss = torch.zeros(())
        for number in range(steps):
            while rounds and number >= rounds[0] > 0:
                self._densify(1 - (len(rounds) - 1) / self._settings.densify_rounds)
                rounds.pop(0)
            self._rate = self._settings.rate_at(number / steps)
            loss = self._step(self._next(), rate_scale=self._rate)
            if (number + 1) % SMOOTH_EVERY == 0:
                self._smooth()
            if progress is not None:
                progress(number + 1, loss)
        self._step.settle(self._observations[-1], rate_scale=self._rate)
        return loss

    def _next(self) -> Observation:
        """Every observation once in random order, then again."""
        if not self._order:
            self._order = self._random.permutation(len(self._observations)).tolist()
        return self._observations[self._order.pop()]

    def _smooth(self) -> None:
        """As much as belongs to the steps since the last time."""
        each = self._rate * SMOOTH_EVERY / len(self._observations)
        if self._smoothing:
            self._step.field.smooth_in_time(min(self._smoothing * each, MOST_AT_ONCE))
        if self._rigidity and self._step.field.takes_positions:
            if self._neighbours is None:
                self._neighbours = nearest_others(self._step.gaussians.means)
            self._step.field.share_motion(self._neighbours, min(self._rigidity * each, MOST_AT_ONCE))

    def _densify(self, share: float) -> None:
        """A round; `share` of all rounds is over with it, and their number grows from the first to the most along with that."""
        self._step.settle(self._observations[-1], rate_scale=self._rate)
        self._neighbours = None
        order = self._random.permutation(len(self._observations)).tolist()
        chosen, others = (
            [self._observations[index] for index in part]
            for part in (order[: self._settings.densify_frames], order[self._settings.densify_frames :])
        )
        shares = shares_of(self._step, chosen)
        # What a tool hides in all of the chosen pictures, or what lies outside of them, others may show.
        hidden = ~on_tissue(self._step, chosen)
        if bool(hidden.any()):
            seen_px = torch.where(
                hidden & on_tissue(self._step, others), shares.seen_px.clamp(min=UNSEEN_PX), shares.seen_px
            )
            shares = replace(shares, seen_px=seen_px)
        densify(self._step, shares, round(self._first_count + (self._most - self._first_count) * share))
