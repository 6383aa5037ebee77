"""Deformation ops in plain torch, any dtype: the oracle of the C++ ones, and differentiable by ordinary autograd."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

BUMP_REACH = 4.0
"""A bump further than this many widths from the time contributes nothing: exp(-16) is 1e-7 of its height."""

CHANNEL_GROUPS = (3, 4, 3, 3)
"""Channels of the basis field: position, rotation (wxyz), log-scale, colour (SH DC)."""


def basis_field(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, padded: bool = False
) -> Tensor:
    """Sum of truncated bumps in time: delta[n] = sum_b exp(-u^2) weights[n, b], u = (tau - center) / width, |u| <= 4.

    After the basis functions of Deform3DGS (Yang et al. 2024, eq. 5), with one timing shared by all channels. `centers` and
    `log_widths` are [N, B], `weights` [N, B, C], `tau` in the units of the centres; returns [N, C]. NaN in a centre or width
    reaches the Gaussian's deltas (it is not mistaken for an inactive bump). `padded` appends zero columns up to 16.
    """
    u = (tau - centers) * torch.exp(-log_widths)
    inactive = u.abs() > BUMP_REACH
    bumps = torch.exp(-(u.masked_fill(inactive, 0.0) ** 2)).masked_fill(inactive, 0.0)
    # Inactive rows are not read, so that what they hold (even NaN) cannot matter.
    deltas = (bumps[..., None] * weights.masked_fill(inactive[..., None], 0.0)).sum(dim=1)
    return torch.nn.functional.pad(deltas, (0, 16 - deltas.shape[1])) if padded else deltas


def basis_field_backward(
    gradient: Tensor, centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of (centers, log_widths, weights) for dL/d(delta) `gradient` [N, C]; exactly zero for inactive bumps.

    Columns of `gradient` beyond C are not looked at.
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
    centers: Tensor,
    log_widths: Tensor,
    weights: Tensor,
    first_moments: Sequence[Tensor],
    second_moments: Sequence[Tensor],
    steps: Tensor,
    learning_rates: Sequence[float] | Tensor,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-8,
) -> None:
    """One lazy Adam step of every bump active at `tau`, in place; the other bumps and their moments are left alone.

    So is a Gaussian whose gradient is zero in every channel: the frame does not show it, and momentum must not move what nobody sees.
    And one whose gradient, squared, is not finite: it would poison the moments for good.

    `first_moments` and `second_moments` hold (centers, log_widths, weights) shaped tensors; `steps` int32 [N, B] counts the
    updates of each bump, so that each one sees Adam's bias correction (Kingma and Ba 2015, algorithm 1) from its own first
    update, however late in a stream it was added. `learning_rates`: position, rotation, log-scale, colour, centres, widths.
    """
    with torch.no_grad():
        gradients = basis_field_backward(gradient, centers, log_widths, weights, tau)
        active = ~(((tau - centers) * torch.exp(-log_widths)).abs() > BUMP_REACH)
        gradient = gradient[:, : weights.shape[2]]
        active &= (gradient != 0).any(dim=1, keepdim=True) & gradient.square().isfinite().all(dim=1, keepdim=True)
        steps += active.to(steps.dtype)
        count = steps.clamp(min=1).to(centers.dtype)
        bias1, bias2 = 1 - beta1**count, 1 - beta2**count
        each = torch.as_tensor(learning_rates, dtype=centers.dtype, device=centers.device)
        channel_rates = each[:4].repeat_interleave(torch.tensor(CHANNEL_GROUPS, device=centers.device))
        rates = (each[4], each[5], channel_rates)
        for parameter, g, m, v, rate in zip(
            (centers, log_widths, weights), gradients, first_moments, second_moments, rates, strict=True
        ):
            shape = active.shape + (1,) * (g.dim() - 2)
            chosen = active.reshape(shape)
            m.copy_(torch.where(chosen, m + (1 - beta1) * (g - m), m))
            v.copy_(torch.where(chosen, v + (1 - beta2) * (g * g - v), v))
            step = rate * (m / bias1.reshape(shape)) / ((v / bias2.reshape(shape)).sqrt() + epsilon)
            parameter.copy_(torch.where(chosen, parameter - step, parameter))


def sample_plane(plane: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear samples [N, C] of `plane` [V, U, C] at `u`, `v` in [-1, 1] (corners aligned, clamped at the border)."""
    grid = torch.stack([u, v], dim=-1)[None, None]
    image = plane.permute(2, 0, 1)[None]
    sampled = torch.nn.functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return sampled[0, :, 0].T


PLANE_AXES = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""Axes (u, v) of the six planes xy, xz, yz, xt, yt, zt; a plane is stored [size of v, size of u, channels]."""


def hexplane_features(
    coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor, xt: Tensor, yt: Tensor, zt: Tensor
) -> Tensor:
    """Product of six bilinear plane samples (HexPlane, Cao and Johnson 2023, eq. 3), one level.

    `coordinates` [N, 4] are x, y, z, t in [-1, 1]; planes are [V, U, C] for the axes of PLANE_AXES. Returns [N, C].
    """
    product = None
    for plane, (a, b) in zip((xy, xz, yz, xt, yt, zt), PLANE_AXES, strict=True):
        value = sample_plane(plane, coordinates[:, a], coordinates[:, b])
        product = value if product is None else product * value
    assert product is not None
    return product


def hexplane_space(coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor) -> Tensor:
    """The part of `hexplane_features` that does not depend on time: the product of the space planes [N, C]."""
    x, y, z = coordinates[:, 0], coordinates[:, 1], coordinates[:, 2]
    return sample_plane(xy, x, y) * sample_plane(xz, x, z) * sample_plane(yz, y, z)


def hexplane_modulate(space: Tensor, coordinates: Tensor, xt: Tensor, yt: Tensor, zt: Tensor) -> Tensor:
    """`space` [N, C] times the samples of three lines [U, C], the time planes already interpolated at one time."""
    product = space
    for axis, line in enumerate((xt, yt, zt)):
        u = coordinates[:, axis]
        product = product * sample_plane(line[None], u, torch.zeros_like(u))
    return product


def hexplane_decode(
    spaces: Sequence[Tensor],
    coordinates: Tensor,
    lines: Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
) -> Tensor:
    """Features through an MLP with ReLU between its layers: [N, outputs].

    The features of a level are its `spaces` [N, C], times its three `lines` [U, C] when these are given; the levels are put
    side by side. `weights` [outputs, inputs] and `biases` [outputs] are those of `torch.nn.Linear`, layer by layer.
    """
    levels = list(spaces)
    if lines:
        levels = [
            hexplane_modulate(space, coordinates, *lines[3 * level : 3 * level + 3])
            for level, space in enumerate(levels)
        ]
    values = torch.cat(levels, dim=1)
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        values = torch.nn.functional.linear(torch.relu(values) if layer else values, weight, bias)
    return values


DELTA_COLUMNS = 16
"""Columns of the frame path's deltas: position 3, rotation 4, log-scale 3, colour 3, opacity logit 1, 2 unused."""

HEAD_COLUMNS = (0, 1, 2, 7, 8, 9, 3, 4, 5, 6, 13)
"""The column of every output of the HexPlane's head, which has log-scales before the rotation."""


def hexplane_deltas(
    spaces: Sequence[Tensor],
    coordinates: Tensor,
    time: Tensor,
    time_planes: Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    order: Tensor | None = None,
    decode: Callable[..., Tensor] | None = None,
) -> Tensor:
    """What the field adds to the raw parameters at `time` (a number in [-1, 1]) in the frame path's columns: [N, 16].

    The time planes [V, U, C], three per level, are interpolated into lines, then `hexplane_decode` (or another `decode`). With `order`,
    row i of the inputs is Gaussian order[i].
    """
    lines = []
    for plane in time_planes:
        at = ((time.reshape(()) + 1) / 2 * (plane.shape[0] - 1)).clamp(0, plane.shape[0] - 1)
        row = at.detach().nan_to_num().long().clamp(max=max(plane.shape[0] - 2, 0))
        lines.append(torch.lerp(plane[row], plane[(row + 1).clamp(max=plane.shape[0] - 1)], at - row))
    outputs = (decode or hexplane_decode)(spaces, coordinates, lines, weights, biases)
    deltas = outputs.new_zeros(outputs.shape[0], DELTA_COLUMNS)
    rows = torch.arange(outputs.shape[0], device=outputs.device) if order is None else order.long()
    return deltas.index_put((rows[:, None], torch.tensor(HEAD_COLUMNS, device=outputs.device)), outputs)
