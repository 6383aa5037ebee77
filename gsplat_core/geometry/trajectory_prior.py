"""Prior of a scope's trajectory: smooth, and without a component at the breathing and heart
frequencies.

Pictures show the scope relative to the tissue. Rigid motion of both at a breathing frequency is
ambiguous. It is resolved by modelling the trajectory as a Gaussian process with a Matérn kernel of
order 7/2. The kernel's length and noise are learned from the trajectory by restricted maximum
likelihood, excluding the component at the given frequencies. A trajectory without that component is
then more likely. The remaining uncertainty decreases with the length of the recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsplat_core.geometry.pose import hat, log
from gsplat_core.threads import one_thread

LENGTHS_S = (0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 2.8, 3.6, 4.6, 6.0, 8.0, 12.0)
"""Candidate kernel lengths in seconds."""
NOISES = (0.003, 0.01, 0.03, 0.1)
"""Candidate noise levels relative to the amplitude of the trajectory."""
PLACES, TURNS = slice(0, 3), slice(3, 6)
"""Slices of the coordinates that share a kernel: positions and rotations."""


@dataclass(frozen=True)
class TrajectoryPrior:
    """Gaussian prior of camera coordinates: positions, and rotation vectors relative to the middle
    camera, in units of the tissue's distance.
    """

    precision: Tensor
    """Precision matrix of each coordinate, [6, C, C]."""
    uncertain: float
    """Root mean square uncertainty of the trajectory along the given frequencies."""

    @one_thread()
    def cost(self, poses: Tensor) -> float:
        """Return the negative log prior of poses [C, 4, 4], up to a constant."""
        y, _ = coordinates(poses)
        return 0.5 * float(torch.einsum("tj,jts,sj->", y, self.precision, y))

    @one_thread()
    def terms(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Return the Gauss-Newton matrix [6 C, 6 C] and gradient [6 C] of the cost by twists of the
        cameras.
        """
        y, by_twist = coordinates(poses)
        pushed = torch.einsum("jts,sj->tj", self.precision, y)
        matrix = torch.einsum("jts,tja,sjb->tasb", self.precision, by_twist, by_twist)
        slope = torch.einsum("tj,tja->ta", pushed, by_twist)
        return matrix.reshape(6 * len(poses), -1), slope.reshape(-1)


def coordinates(poses: Tensor) -> tuple[Tensor, Tensor]:
    """Return camera coordinates [C, 6] and their derivatives by twists of the cameras [C, 6, 6], in
    units of the tissue's distance.
    """
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
    """Learn the prior from a trajectory.

    Args:
        poses: world-to-camera poses [C, 4, 4].
        times_s: times in seconds [C].
        waves: cosines and sines [C, B] whose component is excluded.
    """
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
    """Kernel with its restricted likelihood for a trajectory."""

    likelihood: float
    factor: Tensor
    """Cholesky factor of the kernel matrix [C, C]."""
    triangle: Tensor
    """Triangular QR factor of the whitened constant and waves."""
    scale: Tensor
    """Variance of each coordinate, [6]."""

    def precision(self, one: Tensor) -> Tensor:
        """Return the precision matrices [6, C, C] with a free constant offset."""
        inverse = torch.cholesky_inverse(self.factor)
        inverse = inverse - (inverse @ one) @ (one.T @ inverse) / inverse.sum()
        return inverse / self.scale[:, None, None]

    def variance(self, along: Tensor) -> Tensor:
        """Return the mean variance over time of each coordinate's component along the waves [6]."""
        projected = torch.linalg.solve_triangular(self.triangle.T, along.T, upper=False)
        return self.scale * projected.square().sum(0).mean()


def _matern(apart: Tensor) -> Tensor:
    r = 7**0.5 * apart
    return (1 + r + 0.4 * r**2 + r**3 / 15) * torch.exp(-r)
