"""Motion prior that learns periodic motion and temporal colour changes from the stream.

Motion is forecast from earlier similar moments, for periodic motion such as heartbeat and breathing. This is
forecasting by analogues (Lorenz, "Atmospheric predictability as revealed by naturally occurring analogues", 1969). No
period is estimated, so several or changing periods need no model.

Highlights flicker, noise is random and motion is uncertain. The best prediction of a colour is therefore a mixture of
the moved newest picture, the mean of earlier ones, a blurred picture and other plausible motions. The shares of the
mixture are learned locally from earlier predictions (`LocalShares`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.deformation.field import displaced
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import COLOUR, POSITION, RAW_COLUMNS
from gsplat_core.training.image_motion import CELL_PX, Flow, SurfaceMotion
from gsplat_core.training.motion_prior import AT_FIRST, HORIZON_S, FlowPrior
from gsplat_core.training.steps.photometric import colour_change
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.transfers import tensor_of

Field = NDArray[np.float32]
"""Picture or flow, float32 [h, w, channels]."""
MOST_CELLS = 40
"""Number of cells along the picture's longer side, each with its own mixing weights (shares)."""


@dataclass(frozen=True)
class SharesSettings:
    """Settings of the learning of mixing weights (shares) of several predictions; units are squares of the predicted
    fields' units.
    """

    at_first: tuple[float, ...]
    """Mixing weights, one per prediction, that are used before any observation."""
    decay: float
    """Factor on the accumulated sums at each new frame, so that about the last 1 / (1 - decay) frames count."""
    around_cells: float
    """Standard deviation of the Gaussian over which the sums of neighbouring cells are averaged, in cells."""
    pull: float
    """Weight of the regularisation that pulls a cell's mixing weights of the predictions (pictures or motions) to those of the
    whole picture.
    """
    ridge: float
    """Weight of ridge regression that pulls each prediction's share over the whole picture to its initial value."""


class LocalShares:
    """Recursive least squares with forgetting: observation = sum of share * prediction in each
    cell, regularised towards the fit of the whole picture.

    Memory is K * (K + 1) numbers per cell for K predictions, independent of the stream's length.
    """

    def __init__(self, settings: SharesSettings) -> None:
        self._settings = settings
        self._products: NDArray[np.float32] | None = None
        """Products of the predictions with each other and with the observation, [h, w, K, K + 1]."""

    def learn(self, guesses: Sequence[Field], came: Field, weight: NDArray[np.float32]) -> None:
        """Add an observation `came` [h, w, channels] of earlier predictions, with pixel weights [h, w]."""
        fields = [*guesses, came]
        count, size = len(guesses), cells_for(came.shape)
        products = np.empty((size[1], size[0], count, count + 1), np.float32)
        for row in range(count):
            for column in range(row, count + 1):
                product = (fields[row] * fields[column]).mean(axis=2) * weight
                products[:, :, row, column] = cv2.resize(product, size, interpolation=cv2.INTER_AREA)
                if column < count:
                    products[:, :, column, row] = products[:, :, row, column]
        if self._products is not None and self._products.shape == products.shape:
            products += self._settings.decay * self._products
        self._products = products

    def whole(self) -> NDArray[np.float64]:
        """Return the mixing weights [K] of the predictions, fitted over the whole picture; the initial ones before any
        observation.
        """
        settings, first = self._settings, np.asarray(self._settings.at_first)
        if self._products is None:
            return first
        mean = self._products.mean(axis=(0, 1), dtype=np.float64)
        return np.linalg.solve(mean[:, :-1] + settings.ridge * np.eye(len(first)), mean[:, -1] + settings.ridge * first)

    def local(self, shape: Sequence[int]) -> Field:
        """Return the local mixing weights [h, w, K], interpolated to the size of a field."""
        settings, whole, size = self._settings, self.whole(), (shape[1], shape[0])
        if self._products is None:
            return np.broadcast_to(whole.astype(np.float32), (shape[0], shape[1], len(whole))).copy()
        rows, columns, count, _ = self._products.shape
        flat = self._products.reshape(rows, columns, -1)
        around = blurred(flat, settings.around_cells).reshape(self._products.shape).astype(np.float64)
        left = around[..., :-1] + settings.pull * np.eye(count)
        right = around[..., -1] + settings.pull * whole
        shares = np.linalg.solve(left, right[..., None])[..., 0].astype(np.float32)
        resized = np.asarray(cv2.resize(shares, size, interpolation=cv2.INTER_LINEAR), np.float32)
        return resized.reshape(shape[0], shape[1], count)


def cells_for(shape: Sequence[int]) -> tuple[int, int]:
    """Return the numbers of columns and rows of cells into which fields [h, w, ...] are divided for the mixing weights."""
    height, width = shape[:2]
    shrink = min(1.0, MOST_CELLS / max(height, width))
    return max(1, round(width * shrink)), max(1, round(height * shrink))


def blurred(field: NDArray[np.float32], deviation: float) -> NDArray[np.float32]:
    """Blur a field [h, w, channels] with a Gaussian of standard deviation `deviation` in its pixels."""
    return np.asarray(cv2.GaussianBlur(field, (0, 0), deviation), np.float32).reshape(field.shape)


REMEMBERED = 256
"""Number of remembered frames: some seconds, several heartbeats."""
SOONEST = 6
"""Smallest age in frames of the earlier moments that are compared with now, because the newest frames are always similar."""
EARLIER_COUNTS = 0.64
"""Weight of the dissimilarity of the two preceding moments in the dissimilarity of two moments."""
FOLLOWED = 6
"""Number of most similar moments whose next motion is averaged."""
Weighted: TypeAlias = tuple[float, Flow]
"""Possible motion: its weight in a mean, and the motion as a flow."""


class SimilarMoments:
    """Ring buffer of recent motions with the dissimilarity of each moment to now. Memory and time
    per call are constant.
    """

    def __init__(self) -> None:
        self._begin((1, 1, 2))

    def _begin(self, shape: tuple[int, ...]) -> None:
        self._motions = np.zeros((REMEMBERED, *shape), np.float16)
        """Ring buffer of motions; entry k modulo the buffer's size is the motion from frame k to frame k + 1."""
        columns, rows = cells_for(shape)
        self._coarse = np.zeros((REMEMBERED, rows * columns * 2), np.float32)
        self._unlike = np.full(REMEMBERED, np.inf)
        self._taken = 0

    def take(self, motion: Flow) -> None:
        """Add the newest motion [h, w, 2]. Another size restarts the history. Moments before and after a gap in the
        motions are treated as neighbours, which affects only the few moments next to the gap.
        """
        if self._motions.shape[1:] != motion.shape:
            self._begin(motion.shape)
        row = self._taken % REMEMBERED
        self._motions[row] = motion
        self._coarse[row] = cv2.resize(motion, cells_for(motion.shape), interpolation=cv2.INTER_AREA).ravel()
        apart = np.square(self._coarse - self._coarse[row]).mean(axis=1, dtype=np.float64)
        # The dissimilarity of two moments is that of their last motions plus a share of that of the two moments before.
        of_moments_before = np.roll(self._unlike, 1)
        of_moments_before[np.isinf(of_moments_before)] = 0.0
        self._unlike = apart + EARLIER_COUNTS * of_moments_before
        self._taken += 1
        self._unlike[row] = np.inf
        self._unlike[self._taken :] = np.inf

    def next_motions(self) -> list[Weighted]:
        """Return the motions after the moments most similar to now with weights summing to 1; empty without any."""
        newest = self._taken - 1
        kept = np.arange(max(0, self._taken - REMEMBERED + 1), newest - SOONEST)
        unlike = self._unlike[kept % REMEMBERED]
        best = np.argsort(unlike, kind="stable")[:FOLLOWED]
        if len(best) == 0:
            return []
        weights = np.exp(-unlike[best] / max(unlike[best[0]], 1e-12))
        weights /= weights.sum()
        after = (kept[best] + 1) % REMEMBERED
        return [
            (float(weight), self._motions[row].astype(np.float32)) for weight, row in zip(weights, after, strict=True)
        ]


def weighted_mean(parts: Sequence[Weighted]) -> Field:
    """Return the sum of weighted fields, whose weights sum to 1."""
    mean = np.zeros_like(parts[0][1])
    for weight, field in parts:
        mean += np.float32(weight) * field
    return mean


FOLLOWS = 0.2
"""Weight of the newest picture in the exponential moving mean of earlier pictures."""
BLUR_PX = 1.5
"""Standard deviation of the blurred picture in pixels."""
PICTURE_SHARES = SharesSettings(at_first=(0.0, 0.0, 0.0, 0.0), decay=0.95, around_cells=3.0, pull=200.0, ridge=30.0)
"""Settings of the mixing weights of the alternatives to the moved newest picture: the unmoved newest picture, the mean of earlier
ones, the blurred picture, and the mean over other motions. Units are squared grey levels, 0 to 255.
"""
INVERSE_STEPS = 2
"""Number of fixed-point iterations by which a flow is inverted."""


@dataclass(frozen=True)
class _Guesses:
    moved: Field
    """Newest picture moved by the expected motion, [h, w, 3]."""
    others: list[Field]
    """Differences of the alternative predictions from `moved`, [h, w, 3] each."""


class ExpectedPicture:
    """Prediction of the next picture's colours as a mixture of simple predictions with learned weights."""

    def __init__(self) -> None:
        self._shares = LocalShares(PICTURE_SHARES)
        self._restart()

    def _restart(self) -> None:
        self._newest: Field | None = None
        self._mean: Field | None = None
        """Mean of earlier pictures, warped to the newest one."""
        self._guesses: _Guesses | None = None

    def take(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None, motion: Flow | None) -> None:
        """Add the newest picture.

        Args:
            image: uint8 [H, W, 3].
            mask: [H, W], non-zero on tissue, or None for all.
            motion: flow from the previous picture, or None if unknown. The history then restarts,
                but learned shares are kept.
        """
        picture = image.astype(np.float32)
        if motion is None or self._newest is None or self._newest.shape != picture.shape:
            self._restart()
            self._mean = picture
        else:
            if self._guesses is not None:
                weight = np.ones(picture.shape[:2], np.float32) if mask is None else (mask != 0).astype(np.float32)
                self._shares.learn(self._guesses.others, picture - self._guesses.moved, weight)
                self._guesses = None
            assert self._mean is not None
            before = moved(self._mean, motion)
            self._mean = before + FOLLOWS * (picture - before)
        self._newest = picture

    def after(self, motion: Flow, others: Sequence[Weighted] = ()) -> Field | None:
        """Predict the colours of the next picture for a motion of the tissue.

        Args:
            motion: most likely flow after the newest picture.
            others: weighted alternative flows.

        Returns:
            float32 [H, W, 3] in grey levels, or None before the first picture.
        """
        if self._newest is None or self._mean is None:
            return None
        newest, mean = moved(self._newest, motion), moved(self._mean, motion)
        of_others = [(weight, moved(self._newest, other)) for weight, other in others]
        spread = weighted_mean(of_others) if of_others else newest
        guesses = [self._newest, mean, blurred(newest, BLUR_PX), spread]
        self._guesses = _Guesses(newest, [guess - newest for guess in guesses])
        shares = self._shares.local(newest.shape)
        expected = newest.copy()
        for index, guess in enumerate(self._guesses.others):
            expected += shares[..., index, None] * guess
        return expected.clip(0, 255)


def origin(motion: Flow) -> Flow:
    """Invert a flow: return for each cell the displacement in pixels that brought its content there."""
    came = motion
    for _ in range(INVERSE_STEPS):
        came = _remapped(motion, np.asarray(came / CELL_PX, np.float32))
    return came


def moved(picture: Field, motion: Flow) -> Field:
    """Warp a picture [h, w, channels] of any size by a flow."""
    height, width = picture.shape[:2]
    came_from = cv2.resize(origin(motion), (width, height), interpolation=cv2.INTER_LINEAR)
    scale = width / (motion.shape[1] * CELL_PX)
    return _remapped(picture, np.asarray(came_from * scale, np.float32))


def _remapped(field: Field, back: Field) -> Field:
    """Return the value of a field for each pixel at the pixel's position minus `back` [h, w, 2], in pixels."""
    height, width = field.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    looked_up = cv2.remap(
        field, columns - back[..., 0], rows - back[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(looked_up, np.float32)


REFERENCE_S = 1 / 30
"""Time in seconds to which stored motions are scaled, so that motions of unequal frame intervals are comparable."""
MOTION_SHARES = SharesSettings(at_first=(AT_FIRST, 0.0), decay=0.97, around_cells=3.0, pull=4.0, ridge=0.2)
"""Settings of the mixing weights of the last motion and of the motions after similar moments. Units are squared pixels."""
COLOUR_STEPS = 16
"""Iterations of the colour fit of moved Gaussians to the expected picture."""


@dataclass(frozen=True)
class Expectation:
    """Predicted colours of the next frame, on the device of the Gaussians."""

    motion: SurfaceMotion
    picture: Tensor
    """Predicted colours of the next frame [H, W, 3], 0 to 1."""
    tissue: Tensor
    """Weights of the pixels [H, W], 1 on tissue."""


class LearnedPrior(FlowPrior):
    """Motion prior that mixes the last motion with those after earlier similar moments, and lets colours return to
    their mean.

    Motion is predicted as a flow and colours as an image, both on the host. The mixing weights are learned from how
    well earlier predictions matched the frames that followed. The predictions are applied to the Gaussians on the
    device. The prior assumes a static camera; for a moving one it behaves like `FlowPrior`.
    """

    def forget(self) -> None:
        """Discard everything learned from the stream; see `MotionPrior.forget`."""
        super().forget()
        self._moments = SimilarMoments()
        self._shares = LocalShares(MOTION_SHARES)
        self._picture = ExpectedPicture()
        self._guesses: list[Flow] = []
        """Predictions of the next motion that `LocalShares` mixes: the last motion, and the mean after similar moments."""
        self._expected: Expectation | None = None

    @property
    def horizon_s(self) -> float:
        """Duration in seconds of the predicted motion. Learned predictions cover the next frame only."""
        return HORIZON_S if self._expected is None else min(HORIZON_S, self._interval_s)

    def velocity(self, step: TrainingStep, deltas: Tensor | None = None) -> Tensor | None:
        """Return the predicted velocity of the Gaussians' deltas; see `MotionPrior.velocity`."""
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
            self._picture.take(frame.image, frame.tissue, None)
            return
        self._picture.take(frame.image, frame.tissue, flow)
        ahead, others = self._next_motion(flow, guesses)
        picture = self._picture.after(ahead, others)
        if picture is not None:
            tissue = (
                np.ones(picture.shape[:2], np.float32) if frame.mask is None else (frame.mask != 0).astype(np.float32)
            )
            there = SurfaceMotion(tensor_of(ahead, device), motion.after, motion.after)
            self._expected = Expectation(there, tensor_of(picture / 255, device), tensor_of(tissue, device))

    def _next_motion(self, flow: Flow, guesses: list[Flow]) -> tuple[Flow, list[Weighted]]:
        """Learn mixing weights from the newest motion and predict the next one.

        Returns:
            The predicted motion, and the weighted motions that followed similar moments, in pixels per frame interval.
        """
        scale = np.float32(self._interval_s / REFERENCE_S)
        motion = np.asarray(flow / scale, np.float32)
        if guesses:
            self._shares.learn(guesses, motion, np.ones(motion.shape[:2], np.float32))
        self._moments.take(motion)
        similar = [(weight, np.asarray(each * scale, np.float32)) for weight, each in self._moments.next_motions()]
        of_similar = weighted_mean(similar) if similar else np.zeros_like(flow)
        # Store the predictions as motion per `REFERENCE_S`, like the motions that they will be compared with.
        self._guesses = [np.asarray(each / scale, np.float32) for each in (moved(flow, flow), of_similar)]
        shares = self._shares.local(motion.shape)
        ahead = np.zeros_like(motion)
        for index, guess in enumerate(self._guesses):
            ahead += shares[..., index, None] * guess
        return np.asarray(ahead * scale, np.float32), similar
