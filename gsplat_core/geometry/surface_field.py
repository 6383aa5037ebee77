"""Smooth vector field over a tissue surface, given by vectors at nodes among its points.

The prior is a Gaussian random field with a linear part, which includes rigid motion, and a local
part with a correlation length (kriging with a linear trend). Lengths are in units of the tissue's
distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.threads import one_thread

LINEAR = 0.2
"""Prior standard deviation of the linear part."""
LOCAL = 0.03
"""Prior standard deviation of the local part."""
LENGTH = 0.3
"""Correlation length of the local part."""
APART = 0.13
"""Smallest distance between nodes; larger if it would give more than `MOST_NODES`."""
MOST_NODES = 48
JITTER = 1e-6
"""Diagonal regularisation as a share of the mean variance."""


@dataclass(frozen=True)
class SurfaceField:
    """Nodes of a vector field with its prior."""

    nodes: Tensor
    """Node positions [M, 3]."""
    middle: Tensor
    """Median position of the points [3]."""
    stiffness: Tensor
    """Inverse covariance [M, M]; v' stiffness v / 2 is the negative log prior of values v at the
    nodes.
    """

    @classmethod
    @one_thread()
    def over(cls, points: Tensor, most: int = MOST_NODES) -> SurfaceField:
        """Create a field with at most `most` nodes spread over points [P, 3]."""
        middle = points.median(0).values
        nodes = _spread(points, middle, most)
        return cls(nodes, middle, torch.linalg.inv(_settled(_covariance(nodes, nodes, middle))))

    @one_thread()
    def influence(self, points: Tensor) -> Tensor:
        """Return interpolation weights [P, M] of the nodes' vectors at points [P, 3]."""
        return _covariance(points, self.nodes, self.middle) @ self.stiffness


def _covariance(first: Tensor, second: Tensor, middle: Tensor) -> Tensor:
    first, second = first - middle, second - middle
    linear = LINEAR**2 * (1 + first @ second.T)
    return linear + LOCAL**2 * torch.exp(-0.5 * (torch.cdist(first, second) / LENGTH).square())


def _settled(covariance: Tensor) -> Tensor:
    return covariance + JITTER * covariance.diagonal().mean() * torch.eye(len(covariance), dtype=covariance.dtype)


def _spread(points: Tensor, middle: Tensor, most: int) -> Tensor:
    """Return points selected by farthest-point sampling, starting nearest to the middle."""
    chosen = [int((points - middle).norm(dim=1).argmin())]
    away = (points - points[chosen[0]]).norm(dim=1)
    while len(chosen) < most and float(away.max()) > APART:
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (points - points[chosen[-1]]).norm(dim=1))
    return points[chosen]
