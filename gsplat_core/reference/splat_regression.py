"""Splat regression in plain torch, any floating dtype; test reference of the compiled op."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def whitened(points: Tensor, centres: Tensor, factors: Tensor) -> Tensor:
    """Return A⁻¹(x - b) [k, n, d] of points [n, d] for splats with centres [k, d] and factors [k, d, d]."""
    return torch.linalg.solve(factors, (points - centres[:, None]).mT).mT


def densities(points: Tensor, centres: Tensor, factors: Tensor) -> Tensor:
    """Return the densities [k, n] of normal distributions with means `centres` and covariances A Aᵀ at points."""
    y = whitened(points, centres, factors)
    norm = torch.linalg.det(factors).abs() * (2 * math.pi) ** (points.shape[1] / 2)
    return torch.exp(-0.5 * y.square().sum(-1)) / norm[:, None]


def splat_regression(points: Tensor, centres: Tensor, factors: Tensor, values: Tensor) -> Tensor:
    """Evaluate Σ v g(x) at points. g is the normal density with mean `centres` and covariance A Aᵀ, A = `factors`.

    Differentiable by autograd. Counterpart of `gsplat_core.ops.splat_regression`.
    """
    return densities(points, centres, factors).mT @ values


def splat_regression_gradients(
    points: Tensor, centres: Tensor, factors: Tensor, values: Tensor, gradient: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the closed-form gradients of centres, factors and values.

    Args:
        points: [n, d].
        centres: [k, d].
        factors: [k, d, d].
        values: [k, m].
        gradient: dL/df at the points, [n, m].

    Returns:
        dL/db [k, d], dL/dA [k, d, d] and dL/dv [k, m].
    """
    y = whitened(points, centres, factors)
    g = densities(points, centres, factors)
    h = g * (values @ gradient.mT)
    first = torch.einsum("kn,knd->kd", h, y)
    second = torch.einsum("kn,knd,kne->kde", h, y, y)
    second = second - h.sum(1)[:, None, None] * torch.eye(points.shape[1], dtype=points.dtype, device=points.device)
    transposed = factors.mT
    return (
        torch.linalg.solve(transposed, first[..., None])[..., 0],
        torch.linalg.solve(transposed, second),
        g @ gradient,
    )
