"""HexPlane field ops in plain torch: any floating dtype and device, differentiable by autograd.

`HexPlaneField` (Cao & Johnson 2023) trains with them on the CPU and uses them where no kernels
exist. They are also the reference for tests of the kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION, width_of

HEAD_GROUPS = (POSITION, LOG_SCALE, ROTATION, OPACITY)
"""Output order of the field's network, with log-scales before rotation as in G-SHARP."""
HEAD_COLUMNS = tuple(column for group in HEAD_GROUPS for column in range(group.start, group.stop))
"""Raw column of each output of the network."""


def sample_plane(plane: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Sample `plane` [V, U, C] bilinearly at `u`, `v` in [-1, 1]; returns [N, C].

    Corners are aligned, and coordinates are clamped at the border.
    """
    grid = torch.stack([u, v], dim=-1)[None, None]
    image = plane.permute(2, 0, 1)[None]
    sampled = torch.nn.functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return sampled[0, :, 0].T


PLANE_AXES = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""Axes (u, v) of the planes xy, xz, yz, xt, yt, zt.

A plane is stored as [size of v, size of u, channels].
"""


def hexplane_features(
    coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor, xt: Tensor, yt: Tensor, zt: Tensor
) -> Tensor:
    """Return the product of six bilinear plane samples of one level (Cao & Johnson 2023, eq. 3).

    Args:
        coordinates: x, y, z, t in [-1, 1], [N, 4].
        xy: plane [V, U, C], as the other five planes, with the axes of PLANE_AXES.

    Returns:
        Features [N, C].
    """
    product = None
    for plane, (a, b) in zip((xy, xz, yz, xt, yt, zt), PLANE_AXES, strict=True):
        value = sample_plane(plane, coordinates[:, a], coordinates[:, b])
        product = value if product is None else product * value
    assert product is not None
    return product


def hexplane_space(coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor) -> Tensor:
    """Return the time-independent part of `hexplane_features`: the product [N, C] of space planes."""
    x, y, z = coordinates[:, 0], coordinates[:, 1], coordinates[:, 2]
    return sample_plane(xy, x, y) * sample_plane(xz, x, z) * sample_plane(yz, y, z)


def hexplane_modulate(space: Tensor, coordinates: Tensor, xt: Tensor, yt: Tensor, zt: Tensor) -> Tensor:
    """Multiply `space` [N, C] by samples of three lines [U, C].

    The lines are the time planes interpolated at one time.
    """
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
    """Decode features with an MLP with ReLU between its layers.

    Args:
        spaces: products of the space planes [N, C] of each level; levels are concatenated.
        coordinates: positions and time in [-1, 1], [N, 4].
        lines: three time lines [U, C] per level, multiplied with `spaces`; may be empty.
        weights: weight matrices [outputs, inputs] of the layers, as in `torch.nn.Linear`.
        biases: biases of the layers.

    Returns:
        [N, outputs].
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
    """Return the field's deltas of the raw parameters at `time`.

    The time planes are interpolated to lines at `time`, which `hexplane_decode` (or `decode`)
    combines with the space features.

    Args:
        spaces: per level the product of the space planes, [N, C].
        coordinates: positions in [-1, 1], [N, 4].
        time: normalised time in [-1, 1], one element.
        time_planes: xt, yt, zt of every level, [V, U, C].
        weights: weight matrices of the trunk's layers and the head.
        biases: biases of the same layers.
        order: row i of the inputs belongs to Gaussian order[i]; None for the identity.
        decode: replacement for `hexplane_decode`.

    Returns:
        Deltas [N, 16] in the layout of `scene.gaussians`.
    """
    # No host synchronisation or copy, so that a CUDA graph can capture the call.
    lines = []
    for plane in time_planes:
        at = ((time.reshape(1) + 1) / 2 * (plane.shape[0] - 1)).clamp(0, plane.shape[0] - 1)
        row = at.detach().nan_to_num().long().clamp(max=max(plane.shape[0] - 2, 0))
        next_row = (row + 1).clamp(max=plane.shape[0] - 1)
        lines.append(torch.lerp(plane.index_select(0, row)[0], plane.index_select(0, next_row)[0], at - row))
    outputs = (decode or hexplane_decode)(spaces, coordinates, lines, weights, biases)
    position, log_scale, rotation, opacity = outputs.split([width_of(group) for group in HEAD_GROUPS], dim=1)
    n, no_colour = len(outputs), width_of(COLOUR)
    deltas = torch.cat(
        [
            position,
            rotation,
            log_scale,
            outputs.new_zeros(n, no_colour),
            opacity,
            outputs.new_zeros(n, RAW_COLUMNS - OPACITY.stop),
        ],
        dim=1,
    )
    return deltas if order is None else torch.zeros_like(deltas).index_copy(0, order.long(), deltas)
