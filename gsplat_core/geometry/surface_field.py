"""A field of vectors over tissue that is seen from anywhere: vectors at some nodes among its points, and smoothly in between.

What is expected beforehand is a random field: a part that is linear in the place, of which a rigid motion is one kind, and one that changes over a length
(kriging with a linear trend). All lengths are in units of the tissue's distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.threads import one_thread

LINEAR = 0.2
"""How far the linear part may be expected to move tissue (standard deviation)."""
LOCAL = 0.03
"""The same of the part that changes ..."""
LENGTH = 0.3
"""... over such a length."""
APART = 0.13
"""Between nodes; more where that makes more than ..."""
MOST_NODES = 48
JITTER = 1e-6
"""Of the mean variance: keeps what is nearly singular invertible."""


@dataclass(frozen=True)
class SurfaceField:
    """Where vectors are given, and what follows from them."""

    nodes: Tensor
    """[M, 3]."""
    middle: Tensor
    """[3]: of the points."""
    stiffness: Tensor
    """[M, M]: half of v' stiffness v is how unlikely values v at the nodes are beforehand."""

    @classmethod
    @one_thread()
    def over(cls, points: Tensor, most: int = MOST_NODES) -> SurfaceField:
        """Nodes spread over points [P, 3]."""
        middle = points.median(0).values
        nodes = _spread(points, middle, most)
        return cls(nodes, middle, torch.linalg.inv(_settled(_covariance(nodes, nodes, middle))))

    @one_thread()
    def influence(self, points: Tensor) -> Tensor:
        """How much each point has of each node's vector [P, M]."""
        return _covariance(points, self.nodes, self.middle) @ self.stiffness


def _covariance(first: Tensor, second: Tensor, middle: Tensor) -> Tensor:
    first, second = first - middle, second - middle
    linear = LINEAR**2 * (1 + first @ second.T)
    return linear + LOCAL**2 * torch.exp(-0.5 * (torch.cdist(first, second) / LENGTH).square())


def _settled(covariance: Tensor) -> Tensor:
    return covariance + JITTER * covariance.diagonal().mean() * torch.eye(len(covariance), dtype=covariance.dtype)


def _spread(points: Tensor, middle: Tensor, most: int) -> Tensor:
    """The point nearest to the middle, then always the one that is farthest from those taken."""
    chosen = [int((points - middle).norm(dim=1).argmin())]
    away = (points - points[chosen[0]]).norm(dim=1)
    while len(chosen) < most and float(away.max()) > APART:
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (points - points[chosen[-1]]).norm(dim=1))
    return points[chosen]
