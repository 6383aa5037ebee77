"""How a scope may be expected to go: smoothly, and without a line at the frequencies of breathing and heart beat.

Pictures show where the scope is to the tissue. What both do as one rigid body, at a frequency of the breathing, they do not tell apart; the rest of the
scope's trajectory does: it is taken for a random function whose smoothness is learned from the trajectory itself (a Gaussian process with a Matérn kernel of
order 7/2, its length and noise by restricted maximum likelihood: what swings at the given frequencies takes no part). A trajectory that needs no line
there is then more likely than one with it. How much of one it may have all the same follows, and gets less the longer the recording is.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.geometry.pose import hat, log
from gsplat_core.threads import one_thread

LENGTHS_S = (0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 2.8, 3.6, 4.6, 6.0, 8.0, 12.0)
"""Of the kernel."""
NOISES = (0.003, 0.01, 0.03, 0.1)
"""How far a trajectory jitters, relative to how far it goes."""
PLACES, TURNS = slice(0, 3), slice(3, 6)
"""Coordinates that share a kernel."""


@dataclass(frozen=True)
class TrajectoryPrior:
    """What is expected of the coordinates of some cameras: where they are, and rotation vectors from the one in the middle, times the distance of the tissue."""

    precision: Tensor
    """[6, C, C]."""
    uncertain: float
    """How far off the trajectory may be (root mean square) as far as it is along the given frequencies."""

    @one_thread()
    def cost(self, poses: Tensor) -> float:
        """How unlikely poses [C, 4, 4] are."""
        y, _ = coordinates(poses)
        return 0.5 * float(torch.einsum("tj,jts,sj->", y, self.precision, y))

    @one_thread()
    def terms(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        """The cost's matrix [6 C, 6 C] and slope [6 C] by twists of the cameras."""
        y, by_twist = coordinates(poses)
        pushed = torch.einsum("jts,sj->tj", self.precision, y)
        matrix = torch.einsum("jts,tja,sjb->tasb", self.precision, by_twist, by_twist)
        slope = torch.einsum("tj,tja->ta", pushed, by_twist)
        return matrix.reshape(6 * len(poses), -1), slope.reshape(-1)


def coordinates(poses: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates [C, 6] of cameras, and how twists of the cameras change them [C, 6, 6]. The unit is the distance of the tissue."""
    turned = poses[:, :3, :3].transpose(1, 2)
    place = -(turned @ poses[:, :3, 3:])[:, :, 0]
    relative = torch.eye(4, dtype=poses.dtype).repeat(len(poses), 1, 1)
    relative[:, :3, :3] = turned[len(poses) // 2].T @ turned
    vector = log(relative)[:, 3:]
    cross = hat(vector)
    by_twist = torch.zeros(len(poses), 6, 6, dtype=poses.dtype)
    by_twist[:, :3, :3] = -turned
    by_twist[:, 3:, 3:] = -(torch.eye(3, dtype=poses.dtype) + 0.5 * cross + cross @ cross / 12)
    return torch.cat([place, vector], 1), by_twist


@one_thread()
def learned_from(poses: Tensor, times_s: Tensor, waves: Tensor) -> TrajectoryPrior:
    """The prior of trajectories like that of `poses` [C, 4, 4], at `times_s` [C], as far as that is not along the `waves` [C, B]."""
    y, _ = coordinates(poses)
    one = torch.ones(len(y), 1, dtype=y.dtype)
    apart = (times_s[:, None] - times_s).abs()
    best: list[_Smoothness | None] = [None, None]
    for length_s in LENGTHS_S:
        smooth = _matern(apart / length_s)
        for noise in NOISES:
            factor = torch.linalg.cholesky(smooth + noise**2 * torch.eye(len(y), dtype=y.dtype))
            lines, both = (
                torch.linalg.solve_triangular(factor, part, upper=False) for part in (torch.cat([one, waves], 1), y)
            )
            basis, triangle = torch.linalg.qr(lines)
            left = both - basis @ (basis.T @ both)
            free = len(y) - lines.shape[1]
            scale = (left.square().sum(0) / free).clamp(min=1e-16)
            shared = factor.diagonal().log().sum() + triangle.diagonal().abs().log().sum()
            likelihood = -0.5 * free * scale.log() - shared
            for kind, which in enumerate((PLACES, TURNS)):
                likely = float(likelihood[which].sum())
                before = best[kind]
                if before is None or likely > before.likelihood:
                    best[kind] = _Smoothness(likely, factor, triangle, scale)
    places, turns = best
    assert places is not None and turns is not None
    along = torch.cat([0 * one, waves], 1)
    return TrajectoryPrior(
        torch.cat([places.precision(one)[PLACES], turns.precision(one)[TURNS]]),
        float(places.variance(along)[PLACES].sum().sqrt()),
    )


@dataclass(frozen=True)
class _Smoothness:
    """One kernel, and how likely it makes a trajectory."""

    likelihood: float
    factor: Tensor
    """Of the kernel's matrix [C, C]."""
    triangle: Tensor
    """Of the whitened constant and waves."""
    scale: Tensor
    """[6]: variance of each coordinate."""

    def precision(self, one: Tensor) -> Tensor:
        """[6, C, C]; where a trajectory begins is not known beforehand."""
        inverse = torch.cholesky_inverse(self.factor)
        inverse = inverse - (inverse @ one) @ (one.T @ inverse) / inverse.sum()
        return inverse / self.scale[:, None, None]

    def variance(self, along: Tensor) -> Tensor:
        """Of each coordinate [6], of what may be along the waves, as a mean over time."""
        projected = torch.linalg.solve_triangular(self.triangle.T, along.T, upper=False)
        return self.scale * projected.square().sum(0).mean()


def _matern(apart: Tensor) -> Tensor:
    r = 7**0.5 * apart
    return (1 + r + 0.4 * r**2 + r**3 / 15) * torch.exp(-r)
