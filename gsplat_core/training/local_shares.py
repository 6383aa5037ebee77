"""Locally learned mixture of several predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]
"""Picture or flow, float32 [h, w, channels]."""

MOST_CELLS = 40
"""Number of cells along the longer side with separate shares."""


@dataclass(frozen=True)
class SharesSettings:
    """Settings of the learning; units are squares of the fields' units."""

    at_first: tuple[float, ...]
    """Shares before anything was learned."""
    decay: float
    """Weight of accumulated sums at each new frame; about 1 / (1 - decay) frames are remembered."""
    around_cells: float
    """Standard deviation of a cell's neighbourhood, in cells."""
    pull: float
    """Strength with which a cell's shares are pulled to those of the whole picture."""
    ridge: float
    """Strength with which shares of the whole picture are pulled to the initial ones."""


class LocalShares:
    """Recursive least squares with forgetting: observation = sum of share * prediction in each
    cell, regularised towards the fit of the whole picture.

    Memory is K * (K + 1) numbers per cell for K predictions, independent of the stream's length.
    """

    def __init__(self, settings: SharesSettings) -> None:
        self._settings = settings
        self._products: NDArray[np.float32] | None = None
        """Products of the predictions with each other and with the observation, [h, w, K, K + 1].
        """

    def learn(self, guesses: Sequence[Field], came: Field, weight: NDArray[np.float32]) -> None:
        """Add an observation `came` [h, w, channels] of earlier predictions, with pixel weights [h,
        w].
        """
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
        """Return the shares [K] that fit the whole picture."""
        settings, first = self._settings, np.asarray(self._settings.at_first)
        if self._products is None:
            return first
        mean = self._products.mean(axis=(0, 1), dtype=np.float64)
        return np.linalg.solve(mean[:, :-1] + settings.ridge * np.eye(len(first)), mean[:, -1] + settings.ridge * first)

    def local(self, shape: Sequence[int]) -> Field:
        """Return the local shares [h, w, K] for fields of a shape."""
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
    """Return columns and rows of cells for fields [h, w, ...]."""
    height, width = shape[:2]
    shrink = min(1.0, MOST_CELLS / max(height, width))
    return max(1, round(width * shrink)), max(1, round(height * shrink))


def blurred(field: NDArray[np.float32], deviation: float) -> NDArray[np.float32]:
    """Blur a field of any number of channels."""
    return np.asarray(cv2.GaussianBlur(field, (0, 0), deviation), np.float32).reshape(field.shape)
