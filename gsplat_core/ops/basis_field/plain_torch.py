"""Basis-function field ops in plain torch: any floating dtype and device, differentiable by autograd.

`BasisField` uses them where no kernels exist. They are also the reference for tests of the kernels.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, POSITION, RAW_COLUMNS, ROTATION, width_of

BASIS_GROUPS = (POSITION, ROTATION, LOG_SCALE, COLOUR)
"""Deformed parameters: the first `BASIS_CHANNELS` columns of the raw row."""
BASIS_CHANNELS = width_of(*BASIS_GROUPS)
BUMP_REACH = 4.0
"""Truncation radius of a bump in widths; its height there is exp(-16) = 1e-7."""

LEAST_SQUARED_HEIGHTS = 1e-2
"""Minimum sum of squared bump heights at a time. Below it, weights would become huge."""


def basis_field(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, padded: bool = False
) -> Tensor:
    """Evaluate truncated bumps in time: delta[n] = sum_b exp(-u²) weights[n, b] for |u| <= 4.

    u = (tau - center) / width. Based on the basis functions of Deform3DGS (Yang et al. 2024, eq. 5), with timing shared
    by all channels. NaN in a centre or width propagates to the Gaussian's deltas.

    Args:
        centers: [N, B].
        log_widths: [N, B].
        weights: [N, B, C].
        tau: time in the units of the centres.
        padded: append zero columns up to `RAW_COLUMNS`.

    Returns:
        Deltas [N, C], or [N, 16] if padded.
    """
    u = (tau - centers) * torch.exp(-log_widths)
    inactive = u.abs() > BUMP_REACH
    bumps = torch.exp(-(u.masked_fill(inactive, 0.0) ** 2)).masked_fill(inactive, 0.0)
    # Mask the weights, so that those of inactive bumps have no effect, even if NaN.
    deltas = (bumps[..., None] * weights.masked_fill(inactive[..., None], 0.0)).sum(dim=1)
    return torch.nn.functional.pad(deltas, (0, RAW_COLUMNS - deltas.shape[1])) if padded else deltas


def basis_field_backward(
    gradient: Tensor, centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of (centers, log_widths, weights); exactly zero for inactive bumps.

    Args:
        gradient: dL/d(deltas) [N, C]; further columns are ignored.
    """
    gradient = gradient[:, : weights.shape[2]]
    inverse_width = torch.exp(-log_widths)
    u = (tau - centers) * inverse_width
    inactive = u.abs() > BUMP_REACH
    u = u.masked_fill(inactive, 0.0)
    bumps = torch.exp(-(u**2)).masked_fill(inactive, 0.0)
    slope = bumps * 2.0 * u * torch.einsum("nc,nbc->nb", gradient, weights.masked_fill(inactive[..., None], 0.0))
    return slope * inverse_width.masked_fill(inactive, 0.0), slope * u, bumps[..., None] * gradient[:, None, :]


def basis_field_backward_adam_(
    gradient: Tensor,
    tau: float | Tensor,
    field: Sequence[Tensor],
    first_moments: Sequence[Tensor],
    second_moments: Sequence[Tensor],
    steps: Tensor,
    learning_rates: Sequence[float] | Tensor,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
) -> None:
    """Take one lazy Adam step of every bump active at `tau`, in place.

    Inactive bumps and their moments are not changed. A Gaussian with a zero gradient in all channels is skipped,
    because it is not visible in the frame and momentum must not move it. A Gaussian whose squared gradient is not
    finite is skipped, because it would corrupt the moments permanently. The per-bump step counts give each bump Adam's
    bias correction (Kingma and Ba 2015, algorithm 1) from its own first update.

    Args:
        gradient: dL/d(deltas) [N, 13] or [N, 16].
        tau: normalised time.
        field: centers [N, B], log_widths [N, B], weights [N, B, 13].
        first_moments: tensors with the shapes of `field`.
        second_moments: tensors with the shapes of `field`.
        steps: int32 [N, B], number of updates of each bump.
        learning_rates: six rates: position, rotation, log-scale, colour, centres, widths.
        betas: decay rates of the moments.
        epsilon: term added to the denominator.
    """
    centers, log_widths, weights = field
    beta1, beta2 = betas
    with torch.no_grad():
        gradients = basis_field_backward(gradient, centers, log_widths, weights, tau)
        active = ~(((tau - centers) * torch.exp(-log_widths)).abs() > BUMP_REACH)
        gradient = gradient[:, : weights.shape[2]]
        active &= (gradient != 0).any(dim=1, keepdim=True) & gradient.square().isfinite().all(dim=1, keepdim=True)
        steps += active.to(steps.dtype)
        count = steps.clamp(min=1).to(centers.dtype)
        bias1, bias2 = 1 - beta1**count, 1 - beta2**count
        each = torch.as_tensor(learning_rates, dtype=centers.dtype, device=centers.device)
        channel_rates = each[:4].repeat_interleave(
            torch.tensor([width_of(group) for group in BASIS_GROUPS], device=centers.device)
        )
        rates = (each[4], each[5], channel_rates)
        for parameter, g, m, v, rate in zip(field, gradients, first_moments, second_moments, rates, strict=True):
            shape = active.shape + (1,) * (g.dim() - 2)
            chosen = active.reshape(shape)
            m.copy_(torch.where(chosen, m + (1 - beta1) * (g - m), m))
            v.copy_(torch.where(chosen, v + (1 - beta2) * (g * g - v), v))
            step = rate * (m / bias1.reshape(shape)) / ((v / bias2.reshape(shape)).sqrt() + epsilon)
            parameter.copy_(torch.where(chosen, parameter - step, parameter))


def basis_field_move_to_(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, target: Tensor
) -> None:
    """Change the weights minimally in place so that the deltas at `tau` become `target` [N, C].

    Let h_b = exp(-u_b^2) be the bump heights (see `basis_field`). The minimum-norm weight change is h_b / sum(h^2)
    times the change of the deltas. The deltas at d bump spacings from `tau` change by exp(-d^2 / 2) of it, as by
    training on that frame alone. Rows with a non-finite change, or without a bump near `tau` (`LEAST_SQUARED_HEIGHTS`),
    are skipped.
    """
    with torch.no_grad():
        change = target - basis_field(centers, log_widths, weights, tau)
        u = (tau - centers) * torch.exp(-log_widths)
        heights = torch.where(u.abs() > BUMP_REACH, torch.zeros_like(u), torch.exp(-u * u))
        squared = (heights * heights).sum(dim=1, keepdim=True)
        usable = (squared > LEAST_SQUARED_HEIGHTS) & change.isfinite().all(dim=1, keepdim=True)
        share = torch.where(usable, heights / squared.clamp(min=LEAST_SQUARED_HEIGHTS), torch.zeros_like(heights))
        weights += share[..., None] * torch.where(usable, change, torch.zeros_like(change))[:, None]


def basis_field_add_colours_(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, change: Tensor
) -> None:
    """Change `weights` in place so that the colours at `tau` change by `change` [N, 3].

    Let h_b = exp(-u_b^2) be the bump heights (see `basis_field`). The minimum-norm weight change is
    h_b / sum(h^2) times `change`. The colours at d bump spacings from `tau` change by exp(-d^2 / 2)
    of it. Gaussians with a non-finite change, or without a significant bump height, are skipped.
    """
    u = (tau - centers) * torch.exp(-log_widths)
    heights = torch.where(u.abs() > BUMP_REACH, torch.zeros_like(u), torch.exp(-u * u))
    squared = heights.square().sum(dim=1, keepdim=True)
    usable = (squared > LEAST_SQUARED_HEIGHTS) & change.square().sum(dim=1, keepdim=True).isfinite()
    share = torch.where(usable, heights / squared, torch.zeros_like(heights))
    weights[..., COLOUR] += share[..., None] * torch.where(usable, change, torch.zeros_like(change))[:, None]
