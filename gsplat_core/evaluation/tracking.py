"""Following points of the tissue through a sequence: how far they end up from where they really are, as the STIR challenge measures it.

A point is given by its pixel in the first frame that sees it. A model lifts it by its own depth and carries it along with the Gaussians near
it. Errors are Euclidean, over every later frame that sees the point: in pixels of the evaluated pictures, and in the recording's unit in the
coordinates of the left camera. Schmidt et al., "STIR: Surgical Tattoos in Infrared" (2023), and the STIR challenge of 2024.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.model import Model

WITHIN_PX = (4, 8, 16, 32, 64)
WITHIN_MM = (2, 4, 8, 16, 32)
"""The challenge's thresholds; its figure is the mean share of points within each of them."""
NEIGHBOURS = 8
LEAST_OPACITY = 0.1
"""Gaussians that show less than this carry nothing."""

Points = NDArray[np.float64]


class CarriedPoints:
    """Points of the world at one time, and how a model carries them to others: by the mean motion of the Gaussians nearest to them."""

    def __init__(self, model: Model, points: Points, time_s: float) -> None:
        self._model, self._points = model, points
        start = model.at(time_s)
        self._index, self._weights = _neighbours(start, torch.as_tensor(points, dtype=torch.float32).to(model.device))
        self._start = start.means[self._index].double()

    def at(self, time_s: float) -> Points:
        """Where the points [P, 3] are at a time."""
        now = self._model.at(time_s).means[self._index].double()
        motion = ((now - self._start) * self._weights[..., None]).sum(dim=1)
        return np.asarray(self._points + motion.cpu().numpy())


def _neighbours(gaussians: Gaussians, points: Tensor) -> tuple[Tensor, Tensor]:
    """For each of P points the nearest Gaussians [P, K], and their weights, of sum 1: what they show, less where they are farther away."""
    shows = gaussians.opacities.detach()
    candidates = torch.nonzero(shows > LEAST_OPACITY).flatten()
    if not len(candidates):
        candidates = torch.arange(gaussians.count, device=points.device)
    means = gaussians.means.detach()[candidates]
    distances, nearest = [], []
    for chunk in points.split(64):
        distance, index = torch.cdist(chunk, means).topk(min(NEIGHBOURS, len(candidates)), largest=False)
        distances.append(distance)
        nearest.append(index)
    distance, index = torch.cat(distances).double(), candidates[torch.cat(nearest)]
    width = distance.median(dim=1, keepdim=True).values.clamp_min(1e-9)
    weights = shows[index].double() * torch.exp(-0.5 * (distance / width).square())
    return index, weights / weights.sum(dim=1, keepdim=True).clamp_min(1e-12)


@dataclass(frozen=True)
class TrackErrors:
    """Errors over every point and later frame that sees it."""

    median_mm: float
    mean_mm: float
    median_px: float
    mean_px: float
    within_mm: float
    """Mean share of points nearer than 2, 4, 8, 16 and 32 mm."""
    within_px: float
    """Mean share of points nearer than 4, 8, 16, 32 and 64 pixels."""


@dataclass(frozen=True)
class Tracking:
    """Points of the tissue, followed."""

    model: TrackErrors
    scaled: TrackErrors
    """After all of the model's lengths were multiplied by the one factor of the sequence's depth."""
    still: TrackErrors
    """No motion: each point stays at its first pixel and at its first true depth."""
    points: int
    compared: int
    """Positions that were compared."""


class TrackSums:
    """Takes positions in the left camera's coordinates [P, 3] and pixels [P, 2]."""

    def __init__(self) -> None:
        self._mm: list[Points] = []
        self._px: list[Points] = []

    def add(self, found: Points, true: Points, found_px: Points, true_px: Points) -> None:
        """Compare where points are said to be with where they are."""
        self._mm.append(np.linalg.norm(found - true, axis=1))
        # Behind the camera there is no pixel: as far away as the challenge's last threshold, and no nearer.
        self._px.append(np.nan_to_num(np.linalg.norm(found_px - true_px, axis=1), nan=2.0 * WITHIN_PX[-1]))

    @property
    def count(self) -> int:
        """How many positions were compared."""
        return sum(len(each) for each in self._mm)

    @property
    def errors(self) -> TrackErrors | None:
        """None where nothing was compared."""
        if not self.count:
            return None
        mm, px = np.concatenate(self._mm), np.concatenate(self._px)
        share = lambda errors, limits: float(np.mean([np.mean(errors < limit) for limit in limits]))
        return TrackErrors(
            median_mm=float(np.median(mm)),
            mean_mm=float(mm.mean()),
            median_px=float(np.median(px)),
            mean_px=float(px.mean()),
            within_mm=share(mm, WITHIN_MM),
            within_px=share(px, WITHIN_PX),
        )
