"""Motion prior that learns periodic motion and temporal colour changes from the stream."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsplat_core.deformation.field import displaced
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.layout import COLOUR, POSITION, RAW_COLUMNS
from gsplat_core.training.colour_fit import colour_change
from gsplat_core.training.damping import AT_FIRST
from gsplat_core.training.expected_picture import ExpectedPicture, moved
from gsplat_core.training.image_motion import Flow
from gsplat_core.training.local_shares import LocalShares, SharesSettings
from gsplat_core.training.motion_prior import HORIZON_S, FlowPrior, followed
from gsplat_core.training.similar_moments import SimilarMoments, Weighted, weighted_mean
from gsplat_core.training.step import TrainingStep
from gsplat_core.training.surface_motion import SurfaceMotion
from gsplat_core.transfers import tensor_of

REFERENCE_S = 1 / 30
"""Unit interval of stored motions in seconds."""
SHARES = SharesSettings(at_first=(AT_FIRST, 0.0), decay=0.97, around_cells=3.0, pull=4.0, ridge=0.2)
"""Settings for the shares of the last motion and of motions after similar moments, in squared
pixels.
"""


COLOUR_STEPS = 16
"""Iterations of the colour fit of moved Gaussians to the expected picture."""


@dataclass(frozen=True)
class Expectation:
    """Expected next frame, on the device."""

    motion: SurfaceMotion
    picture: Tensor
    """Colours [H, W, 3], 0 to 1."""
    tissue: Tensor
    """Weights [H, W], 1 on tissue."""


class LearnedPrior(FlowPrior):
    """Motion prior that mixes the last motion with those after earlier similar moments, and lets
    colours return to their mean.

    The mixture is learned on the host from earlier predictions in the picture, and applied to
    Gaussians on the device. It assumes a static camera; for a moving one it behaves like
    `FlowPrior`.
    """

    def forget(self) -> None:
        """See `MotionPrior.forget`."""
        super().forget()
        self._moments = SimilarMoments()
        self._shares = LocalShares(SHARES)
        self._picture = ExpectedPicture()
        self._guesses: list[Flow] = []
        """Predictions of the next motion."""
        self._expected: Expectation | None = None

    @property
    def horizon_s(self) -> float:
        """See `MotionPrior.horizon_s`. Learned predictions cover the next frame only."""
        return HORIZON_S if self._expected is None else min(HORIZON_S, self._interval_s)

    def velocity(self, step: TrainingStep, deltas: Tensor | None = None) -> Tensor | None:
        """See `MotionPrior.velocity`."""
        expected = self._expected
        if expected is None or self._usable_motion() is None:
            return super().velocity(step, deltas)
        with torch.no_grad():
            now = step.at(self.newest_s) if deltas is None else displaced(step.gaussians, deltas)
            moving = expected.motion.ahead(now.means)
            there = replace(now, means=now.means + moving)
            velocity = moving.new_zeros(moving.shape[0], RAW_COLUMNS)
            velocity[:, POSITION] = moving
            velocity[:, COLOUR] = colour_change(
                there, expected.motion.after, expected.picture, expected.tissue, COLOUR_STEPS
            )
        return velocity / self._interval_s

    def _take(self, frame: Frame, flow: Flow | None, device: torch.device) -> None:
        motion, guesses = self._usable_motion(), self._guesses
        self._expected, self._guesses = None, []
        if flow is None or motion is None or motion.before != motion.after:
            self._picture.take(frame.image, followed(frame), None)
            return
        self._picture.take(frame.image, followed(frame), flow)
        ahead, others = self._next_motion(flow, guesses)
        picture = self._picture.after(ahead, others)
        if picture is not None:
            tissue = (
                np.ones(picture.shape[:2], np.float32) if frame.mask is None else (frame.mask != 0).astype(np.float32)
            )
            there = SurfaceMotion(tensor_of(ahead, device), motion.after, motion.after)
            self._expected = Expectation(there, tensor_of(picture / 255, device), tensor_of(tissue, device))

    def _next_motion(self, flow: Flow, guesses: list[Flow]) -> tuple[Flow, list[Weighted]]:
        """Learn from the newest motion and predict the next one. Returns the prediction and the
        weighted motions after similar moments, in pixels per interval.
        """
        scale = np.float32(self._interval_s / REFERENCE_S)
        motion = np.asarray(flow / scale, np.float32)
        if guesses:
            self._shares.learn(guesses, motion, np.ones(motion.shape[:2], np.float32))
        self._moments.take(motion)
        similar = [(weight, np.asarray(each * scale, np.float32)) for weight, each in self._moments.next_motions()]
        of_similar = weighted_mean(similar) if similar else np.zeros_like(flow)
        # Predictions are stored in the unit of the learned motions.
        self._guesses = [np.asarray(each / scale, np.float32) for each in (moved(flow, flow), of_similar)]
        shares = self._shares.local(motion.shape)
        ahead = np.zeros_like(motion)
        for index, guess in enumerate(self._guesses):
            ahead += shares[..., index, None] * guess
        return np.asarray(ahead * scale, np.float32), similar
